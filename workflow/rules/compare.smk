"""Errors and run times of the contenders of a comparison. Errors may be taken beside other jobs; run times need the machine for themselves."""

ERROR_KEYS = ("data", "trajectories", "horizons", "ladder", "learned")
TIMING_KEYS = ("data", "trajectories", "ladder", "learned", "timing")


def truth(wildcards):
    return STUDY.data_stamp(STUDY.comparisons[wildcards.comparison]["data"], "test")


def learned_models(wildcards):
    return [path for model in STUDY.comparisons[wildcards.comparison]["learned"] for path in STUDY.model_files(model)]


def asked(key, default):
    """A resource of a comparison, for the scheduler."""
    return lambda wildcards: STUDY.resource("comparisons", wildcards.comparison, key, default)


def device_of_rollouts(wildcards, resources):
    """Of what is granted: rows say where they come from, but a GPU where there was none compares nothing again."""
    return "cuda" if resources.gpu else "cpu"


rule errors:
    input:
        data=truth,
        models=learned_models,
    output:
        f"{RESULTS}/comparisons/{{comparison}}/errors.json",
    params:
        recipe=lambda wildcards: STUDY.comparison_recipe(wildcards.comparison, ERROR_KEYS, "errors"),
        device=device_of_rollouts,
    log:
        f"{RESULTS}/logs/errors/{{comparison}}.log",
    benchmark:
        f"{RESULTS}/benchmarks/errors/{{comparison}}.tsv"
    threads: 1
    resources:
        mem_mb=asked("mem_mb", 4000),
        runtime=asked("runtime", 120),
        gpu=asked("gpus", 0),
    message:
        "Errors of the contenders on {wildcards.comparison}"
    shell:
        "{PYTHON} -m workflow.scripts.errors {STUDY.path} {wildcards.comparison} {output} {params.device} > {log} 2>&1"


rule timing:
    input:
        data=truth,
        models=learned_models,
    output:
        f"{RESULTS}/comparisons/{{comparison}}/timing.json",
    params:
        recipe=lambda wildcards: STUDY.comparison_recipe(wildcards.comparison, TIMING_KEYS, "timing"),
    log:
        f"{RESULTS}/logs/timing/{{comparison}}.log",
    benchmark:
        f"{RESULTS}/benchmarks/timing/{{comparison}}.tsv"
    # All cores, of which it uses one: a job beside it would be in its figures.
    threads: workflow.cores
    resources:
        mem_mb=asked("mem_mb", 4000),
        runtime=asked("runtime", 60),
    message:
        "Timing the contenders on {wildcards.comparison}, alone on the machine"
    shell:
        "OMP_NUM_THREADS=1 {PYTHON} -m workflow.scripts.timing {STUDY.path} {wildcards.comparison} {output} > {log} 2>&1"
