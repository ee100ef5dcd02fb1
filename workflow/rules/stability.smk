"""The stress matrix: a job a case, since starting Taichi and compiling take longer than most cells; then summary and report."""


rule stability_case:
    output:
        f"{RESULTS}/cases/{{case}}.json",
    params:
        code=lambda wildcards: code_hash("workflow.scripts.stability_case", f"sim.stability.{wildcards.case}"),
    log:
        f"{RESULTS}/logs/stability_case/{{case}}.log",
    benchmark:
        f"{RESULTS}/benchmarks/stability_case/{{case}}.tsv"
    threads: 1
    resources:
        mem_mb=1500,
        runtime=30,
    message:
        "Stress: {wildcards.case}"
    shell:
        "{PYTHON} -m workflow.scripts.stability_case {wildcards.case} {output} > {log} 2>&1"


rule report:
    input:
        expand(f"{RESULTS}/cases/{{case}}.json", case=STUDY.stability),
    output:
        summary=f"{RESULTS}/summary.json",
        report=f"{RESULTS}/report.html",
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
