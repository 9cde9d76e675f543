# Editing a figure repeats this stage only.
rule report:
    input:
        rules.aggregate.output,
    output:
        f"{VIEW}/report/index.html",
    params:
        sources=sources("reports"),
    shell:
        "'{sys.executable}' -m reports experiment {VIEW}/tables {output}"
