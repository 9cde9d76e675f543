# Editing a figure reruns this and nothing else.
rule report:
    input:
        rules.aggregate.output,
    output:
        f"{OUT}/report/index.html",
    params:
        sources=sources("reports"),
    shell:
        "{STAGE} report {OUT}/tables {output}"
