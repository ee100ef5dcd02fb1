"""The stress matrix: a few jobs of several cases, since starting Taichi and compiling take longer than most cells; then summary and report."""


rule stress:
    output:
        f"{RESULTS}/cells/{{job}}.json",
    params:
        cases=lambda wildcards: STUDY.stability[wildcards.job],
        code=lambda wildcards: STUDY.stress_recipe(wildcards.job),
    log:
        f"{RESULTS}/logs/stress/{{job}}.log",
    benchmark:
        f"{RESULTS}/benchmarks/stress/{{job}}.tsv"
    threads: 1
    resources:
        mem_mb=1500,
        runtime=30,
    message:
        "Stress: {params.cases} (progress in {log})"
    shell:
        "{PYTHON} -m workflow.scripts.stress {output} {params.cases} > {log} 2>&1"


rule report:
    input:
        expand(f"{RESULTS}/cells/{{job}}.json", job=STUDY.stability),
    output:
        summary=f"{RESULTS}/summary.json",
        report=report(f"{RESULTS}/report.html", caption="../report/stability.rst", category="Report"),
        page=f"{RESULTS}/stability.md",
    params:
        recipe=STUDY.stability_recipe(),
    log:
        f"{RESULTS}/logs/report.log",
    benchmark:
        f"{RESULTS}/benchmarks/report.tsv"
    threads: 1
    resources:
        mem_mb=1000,
        runtime=10,
    message:
        "Writing {output.report}"
    shell:
        "{PYTHON} -m workflow.scripts.stability_report {STUDY.path} {output} {input} > {log} 2>&1"
