# Editing a figure repeats this stage only.
rule report:
    input:
        rules.aggregate.output,
    output:
        # the page loads its data from files next to it
        shown(directory(f"{VIEW}/report"), "report", "Report", "interactive report", "index.html"),
    params:
        sources=sources(
            "reports", "workflows/outcomes.py", "workflows/summary.py", "workflows/metrics"
        ),
    run:
        run_stage("reports", "experiment", f"{VIEW}/tables", f"{output[0]}/index.html")
