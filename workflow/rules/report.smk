"""Summary and report of a study; what ``snakemake --report`` shows is marked where it is made."""


def pictures(wildcards):
    """What the report embeds: see ``workflow.results.assets``."""
    return STUDY.overview + [path for comparison in STUDY.comparisons for path in STUDY.pictures(comparison)]


rule report:
    input:
        expand(f"{RESULTS}/comparisons/{{comparison}}/{{name}}.json", comparison=STUDY.comparisons, name=["errors", "timing"]),
        [STUDY.data_stamp(STUDY.models[model]["data"], "learning") for model in STUDY.trained],
        [path for model in STUDY.trained for path in STUDY.model_files(model)],
        pictures,
    output:
        summary=f"{RESULTS}/summary.json",
        report=report(f"{RESULTS}/report.html", caption="../report/report.rst", category="Report"),
        pages=report(directory(f"{RESULTS}/report"), patterns=["{scene}.html"], caption="../report/scene.rst", category="Report"),
    params:
        recipe=STUDY.report_recipe(),
    log:
        f"{RESULTS}/logs/report.log",
    benchmark:
        f"{RESULTS}/benchmarks/report.tsv"
    threads: 1
    resources:
        mem_mb=2000,
        runtime=10,
    message:
        "Writing {output.report}"
    shell:
        "{PYTHON} -m workflow.scripts.summary {STUDY.path} {output.summary} {output.report} > {log} 2>&1"
