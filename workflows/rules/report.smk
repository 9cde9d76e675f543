# Editing a figure repeats this stage only.
rule report:
    input:
        rules.aggregate.output,
    output:
        f"{VIEW}/report/index.html",
        shown(f"{VIEW}/report/whole.html", "report", "Report", "interactive report"),
    params:
        sources=sources(
            "reports", "workflows/outcomes.py", "workflows/summary.py", "workflows/metrics"
        ),
    run:
        run_stage("reports", "experiment", f"{VIEW}/tables", output[0])
