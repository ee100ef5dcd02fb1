"""Trainings, one a model and seed. The run folder is not an output, so that it survives a failed or killed job; what others need is copied out."""


def training(key, default):
    """An entry of a model configuration's ``training``, for the scheduler."""
    return lambda wildcards: STUDY.configs[wildcards.model].get("training", {}).get(key, default)


rule train:
    input:
        lambda wildcards: STUDY.data_stamp(STUDY.models[wildcards.model]["data"], "learning"),
    output:
        model=f"{RESULTS}/models/{{model}}/seed-{{seed}}.pt",
        done=f"{RESULTS}/models/{{model}}/seed-{{seed}}.json",
    params:
        recipe=lambda wildcards: STUDY.train_recipe(wildcards.model, wildcards.seed),
        run=lambda wildcards: STUDY.run_folder(wildcards.model, wildcards.seed),
        config=lambda wildcards: STUDY.models[wildcards.model]["config"],
        data=lambda wildcards: STUDY.data_folder(STUDY.models[wildcards.model]["data"], "learning"),
        variant=lambda wildcards: "".join(f"--variant {name}" for name in [STUDY.models[wildcards.model].get("variant")] if name),
        budget=lambda wildcards: " ".join(f"--{key} {value}" for key, value in STUDY.budget(wildcards.model).items()),
    log:
        f"{RESULTS}/logs/train/{{model}}-{{seed}}.log",
    benchmark:
        f"{RESULTS}/benchmarks/train/{{model}}-{{seed}}.tsv"
    threads: training("threads", 1)
    resources:
        mem_mb=4000,
        runtime=lambda wildcards: int(2 * STUDY.budget(wildcards.model).get("minutes", training("minutes", 600)(wildcards)) + 10),
        gpu=lambda wildcards: int(training("device", "auto")(wildcards) == "cuda"),
    priority: 100
    message:
        "Training {wildcards.model}, seed {wildcards.seed} (progress in {log})"
    shell:
        "( {PYTHON} -m workflow.scripts.keep {params.run} {params.recipe} --"
        " {PYTHON} -m learn train {params.config} --data {params.data} --out {params.run} --seed {wildcards.seed} --threads {threads} {params.variant}"
        " {params.budget}"
        " && cp {params.run}/best.pt {output.model} && cp {params.run}/done.json {output.done} ) > {log} 2>&1"
