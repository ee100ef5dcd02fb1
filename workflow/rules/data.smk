"""Ground truth. The two parts of a data set (train and valid; test) are jobs of their own: more test trajectories do not mean a new training."""


def generate_commands(wildcards):
    """One ``sim generate`` a split, continuing what an earlier run left if that was made by the same recipe."""
    entry, folder = STUDY.data[wildcards.data], STUDY.data_folder(wildcards.data, wildcards.part)
    keep = f"{PYTHON} -m workflow.scripts.keep {folder} {STUDY.data_recipe(wildcards.data, wildcards.part)} --"
    options = "".join(f" --{key} {entry[key]}" for key in ("variant", "frames", "seed") if key in entry)
    return " && ".join(
        f"{keep} {PYTHON} -m sim generate {entry['scene']}{options} --split {split} --count {entry[split]} --out {folder} --jobs $JOBS"
        for split in PARTS[wildcards.part]
        if entry[split]
    )


rule data:
    output:
        f"{RESULTS}/data/{{data}}/{{part}}.json",
    params:
        recipe=lambda wildcards: STUDY.data_recipe(wildcards.data, wildcards.part),
        commands=generate_commands,
        folder=lambda wildcards: STUDY.data_folder(wildcards.data, wildcards.part),
    log:
        f"{RESULTS}/logs/data/{{data}}-{{part}}.log",
    benchmark:
        f"{RESULTS}/benchmarks/data/{{data}}-{{part}}.tsv"
    threads: 2
    resources:
        mem_mb=2000,
        runtime=60,
    message:
        "Generating {wildcards.data}, {wildcards.part} (progress in {log})"
    shell:
        "( JOBS={threads}; {params.commands} && cp {params.folder}/dataset.json {output} ) > {log} 2>&1"
