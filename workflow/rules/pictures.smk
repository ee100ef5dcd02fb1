"""Films, stills and figures, from trajectory files and rows."""


def film_shards(wildcards):
    films = STUDY.comparisons[wildcards.comparison]["films"]
    return [f"{RESULTS}/comparisons/{wildcards.comparison}/rollouts/{model}.h5" for model in films]


rule rollouts:
    input:
        data=truth,
        models=learned_models,
        rows=f"{RESULTS}/comparisons/{{comparison}}/errors.json",
    output:
        directory(f"{RESULTS}/comparisons/{{comparison}}/rollouts"),
    params:
        recipe=lambda wildcards: STUDY.comparison_recipe(wildcards.comparison, ("learned", "films"), "rollouts"),
        device=device_of_rollouts,
        shards=film_shards,
    log:
        f"{RESULTS}/logs/rollouts/{{comparison}}.log",
    benchmark:
        f"{RESULTS}/benchmarks/rollouts/{{comparison}}.tsv"
    threads: 1
    resources:
        mem_mb=asked("mem_mb", 4000),
        runtime=asked("runtime", 60),
        gpu=asked("gpus", 0),
    message:
        "Rollouts to film on {wildcards.comparison}"
    shell:
        "{PYTHON} -m workflow.scripts.rollouts {STUDY.path} {wildcards.comparison} {params.device} {input.rows} {output}/truth.h5 {params.shards} > {log} 2>&1"


rule film:
    input:
        rollouts=f"{RESULTS}/comparisons/{{comparison}}/rollouts",
        timing=f"{RESULTS}/comparisons/{{comparison}}/timing.json",
    output:
        film=report(
            f"{RESULTS}/pictures/{{comparison}}/{{model}}.mp4",
            caption="../report/film.rst", category="{comparison}", labels={"figure": "film of {model}"},
        ),
        still=f"{RESULTS}/pictures/{{comparison}}/{{model}}.png",
    params:
        code=code_hash("workflow.scripts.film"),
    log:
        f"{RESULTS}/logs/film/{{comparison}}-{{model}}.log",
    benchmark:
        f"{RESULTS}/benchmarks/film/{{comparison}}-{{model}}.tsv"
    threads: 1
    resources:
        mem_mb=2000,
        runtime=30,
    message:
        "Filming {wildcards.model} on {wildcards.comparison}"
    shell:
        "{PYTHON} -m workflow.scripts.film {input.rollouts}/truth.h5 {input.rollouts}/{wildcards.model}.h5 {input.timing} {output} > {log} 2>&1"


rule strip:
    input:
        f"{RESULTS}/comparisons/{{comparison}}/rollouts",
    output:
        f"{RESULTS}/pictures/{{comparison}}/strip.png",
    params:
        code=code_hash("workflow.scripts.strip"),
        shards=film_shards,
    log:
        f"{RESULTS}/logs/strip/{{comparison}}.log",
    benchmark:
        f"{RESULTS}/benchmarks/strip/{{comparison}}.tsv"
    threads: 1
    resources:
        mem_mb=2000,
        runtime=30,
    message:
        "Film strip of {wildcards.comparison}"
    shell:
        "{PYTHON} -m workflow.scripts.strip {output} {input}/truth.h5 {params.shards} > {log} 2>&1"


ruleorder: strip > film


rule figures:
    input:
        rows=f"{RESULTS}/comparisons/{{comparison}}/errors.json",
        timing=f"{RESULTS}/comparisons/{{comparison}}/timing.json",
    output:
        report(
            f"{RESULTS}/pictures/{{comparison}}/error_over_run_time.svg",
            caption="../report/error_over_run_time.rst", category="{comparison}", labels={"figure": "error over run time"},
        ),
        f"{RESULTS}/pictures/{{comparison}}/error_over_time.svg",
        f"{RESULTS}/pictures/{{comparison}}/kinetic_energy.svg",
    params:
        code=code_hash("workflow.scripts.figures"),
    log:
        f"{RESULTS}/logs/figures/{{comparison}}.log",
    benchmark:
        f"{RESULTS}/benchmarks/figures/{{comparison}}.tsv"
    threads: 1
    resources:
        mem_mb=2000,
        runtime=10,
    message:
        "Figures of {wildcards.comparison}"
    shell:
        "{PYTHON} -m workflow.scripts.figures {input.rows} {input.timing} {output} > {log} 2>&1"


rule speed_ups:
    input:
        [STUDY.comparison_file(comparison, f"{name}.json") for comparison in STUDY.comparisons for name in ("errors", "timing")],
    output:
        report(f"{RESULTS}/pictures/speed_ups.svg", caption="../report/speed_ups.rst", category="Report"),
    params:
        code=code_hash("workflow.scripts.speed_ups"),
    log:
        f"{RESULTS}/logs/speed_ups.log",
    benchmark:
        f"{RESULTS}/benchmarks/speed_ups.tsv"
    threads: 1
    resources:
        mem_mb=2000,
        runtime=10,
    message:
        "Figure of the speed-ups"
    shell:
        "{PYTHON} -m workflow.scripts.speed_ups {output} {input} > {log} 2>&1"


rule ablation:
    input:
        rows=f"{RESULTS}/comparisons/{{comparison}}/errors.json",
    output:
        report(
            f"{RESULTS}/pictures/{{comparison}}/ablation.svg",
            caption="../report/ablation.rst", category="{comparison}", labels={"figure": "ablations"},
        ),
    params:
        code=lambda wildcards: STUDY.comparison_recipe(wildcards.comparison, ("axes",), "ablation"),
    log:
        f"{RESULTS}/logs/ablation/{{comparison}}.log",
    benchmark:
        f"{RESULTS}/benchmarks/ablation/{{comparison}}.tsv"
    threads: 1
    resources:
        mem_mb=2000,
        runtime=10,
    message:
        "Figure of the ablations on {wildcards.comparison}"
    shell:
        "{PYTHON} -m workflow.scripts.ablation {STUDY.path} {wildcards.comparison} {input.rows} {output} > {log} 2>&1"


rule generalisation:
    input:
        lambda wildcards: [STUDY.comparison_file(name, "errors.json") for name in STUDY.generalised(wildcards.comparison)],
    output:
        report(
            f"{RESULTS}/pictures/{{comparison}}/generalisation.svg",
            caption="../report/generalisation.rst", category="{comparison}", labels={"figure": "beyond the training"},
        ),
    params:
        code=lambda wildcards: STUDY.comparison_recipe(wildcards.comparison, ("generalisation",), "generalisation"),
    log:
        f"{RESULTS}/logs/generalisation/{{comparison}}.log",
    benchmark:
        f"{RESULTS}/benchmarks/generalisation/{{comparison}}.tsv"
    threads: 1
    resources:
        mem_mb=2000,
        runtime=10,
    message:
        "Figure of errors beyond the training of {wildcards.comparison}"
    shell:
        "{PYTHON} -m workflow.scripts.generalisation {STUDY.path} {wildcards.comparison} {output} {input} > {log} 2>&1"


rule training_curve:
    input:
        learned_models,
    output:
        f"{RESULTS}/pictures/{{comparison}}/training.svg",
    params:
        code=code_hash("workflow.scripts.training_curve"),
        runs=lambda wildcards: [f"{label}={folder}" for label, folder in STUDY.training_runs(wildcards.comparison).items()],
    log:
        f"{RESULTS}/logs/training_curve/{{comparison}}.log",
    benchmark:
        f"{RESULTS}/benchmarks/training_curve/{{comparison}}.tsv"
    threads: 1
    resources:
        mem_mb=2000,
        runtime=10,
    message:
        "Training curve of {wildcards.comparison}"
    shell:
        "{PYTHON} -m workflow.scripts.training_curve {output} {params.runs:q} > {log} 2>&1"
