"""Ground truth. The two parts of a data set (train and valid; test) are jobs of their own: more test trajectories do not mean a new training."""


def generate_commands(part):
    """One ``sim generate`` a split, continuing what an earlier run left if that was made by the same recipe."""

    def commands(wildcards):
        entry, folder = STUDY.data[wildcards.data], STUDY.data_folder(wildcards.data, part)
        keep = f"{PYTHON} -m workflow.scripts.keep {folder} {STUDY.data_recipe(wildcards.data, part)} --"
        options = "".join(f" --{key} {entry[key]}" for key in ("variant", "frames", "seed") if key in entry)
        return " && ".join(
            f"{keep} {PYTHON} -m sim generate {entry['scene']}{options} --split {split} --count {entry[split]} --out {folder} --jobs $JOBS"
            for split in PARTS[part]
            if entry[split]
        )

    return commands


def requested(key, default):
    """A resource of a data set, for the scheduler."""
    return lambda wildcards: STUDY.resource("data", wildcards.data, key, default)


# What is learnt from goes first, then the trainings, then all that can be done beside them on the cores that are left.
rule learning_data:
    output:
        f"{RESULTS}/data/{{data}}/learning.json",
    params:
        commands=generate_commands("learning"),
        folder=lambda wildcards: STUDY.data_folder(wildcards.data, "learning"),
    log:
        f"{RESULTS}/logs/learning_data/{{data}}.log",
    benchmark:
        f"{RESULTS}/benchmarks/learning_data/{{data}}.tsv"
    threads: requested("threads", 2)
    resources:
        mem_mb=lambda wildcards, threads: STUDY.resource("data", wildcards.data, "mem_mb", 1000 * threads),
        runtime=requested("runtime", 60),
    priority: 200
    message:
        "Generating {wildcards.data} to learn from (progress in {log})"
    shell:
        "( JOBS={threads}; {params.commands} && cp {params.folder}/dataset.json {output} ) > {log} 2>&1"


use rule learning_data as test_data with:
    output:
        f"{RESULTS}/data/{{data}}/test.json",
    params:
        commands=generate_commands("test"),
        folder=lambda wildcards: STUDY.data_folder(wildcards.data, "test"),
    log:
        f"{RESULTS}/logs/test_data/{{data}}.log",
    benchmark:
        f"{RESULTS}/benchmarks/test_data/{{data}}.tsv"
    threads: requested("threads", 1)
    priority: 0
    message:
        "Generating {wildcards.data} to test on (progress in {log})"
