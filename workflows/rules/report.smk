# Editing a figure reruns this and nothing else.
rule report:
    input:
        rules.aggregate.output,
    output:
        f"{VIEW}/report/index.html",
    params:
        sources=sources("reports"),
    shell:
        "{STAGE} report {VIEW}/tables {output}"
