"""Trainings, one a model and seed. The run folder is not an output, so that it survives a failed or killed job; what others need is copied out."""


def training(model, key, default):
    """An entry of a model configuration's ``training``, for the scheduler."""
    return STUDY.configs[model].get("training", {}).get(key, default)


def gpus(wildcards):
    """GPUs of a training: the study's, or one where the configuration wants one."""
    return STUDY.resource("models", wildcards.model, "gpus", int(training(wildcards.model, "device", "auto") == "cuda"))


def threads_each(wildcards):
    """CPU threads of each process of a training."""
    return STUDY.resource("models", wildcards.model, "threads", training(wildcards.model, "threads", 1))


def minutes(wildcards):
    """Time limit of a training. What it cuts off goes on from its checkpoint when the job is tried again."""
    budget = STUDY.budget(wildcards.model).get("minutes", training(wildcards.model, "minutes", 600))
    return STUDY.resource("models", wildcards.model, "runtime", int(2 * budget + 10))


def learn(wildcards, threads, resources):
    """Python's arguments up to ``learn``: a process a GPU, by ``torchrun``. Snakemake grants no more GPUs and threads than there are."""
    return f"-m torch.distributed.run --standalone --nproc-per-node {resources.gpu} -m learn" if resources.gpu > 1 else "-m learn"


def device(wildcards, resources):
    """The study's choice of the device, over the configuration's."""
    chosen = STUDY.resource("models", wildcards.model, "gpus", -1)
    return "" if chosen < 0 else f"--device {'cuda' if chosen else 'cpu'}"


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
        # Of what is granted: no part of the result, so that another number of GPUs trains nothing again.
        learn=learn,
        device=device,
        threads=lambda wildcards, threads, resources: max(1, threads // max(1, resources.gpu)),
    log:
        f"{RESULTS}/logs/train/{{model}}-{{seed}}.log",
    benchmark:
        f"{RESULTS}/benchmarks/train/{{model}}-{{seed}}.tsv"
    threads: lambda wildcards: threads_each(wildcards) * max(1, gpus(wildcards))
    resources:
        mem_mb=lambda wildcards: STUDY.resource("models", wildcards.model, "mem_mb", 4000 * max(1, gpus(wildcards))),
        runtime=minutes,
        gpu=gpus,
    priority: 100
    message:
        "Training {wildcards.model}, seed {wildcards.seed} (progress in {log})"
    shell:
        "( {PYTHON} -m workflow.scripts.keep {params.run} {params.recipe} --"
        " {PYTHON} {params.learn} train {params.config} --data {params.data} --out {params.run} --seed {wildcards.seed} --threads {params.threads}"
        " {params.device} {params.variant} {params.budget}"
        " && cp {params.run}/best.pt {output.model} && cp {params.run}/done.json {output.done} ) > {log} 2>&1"
