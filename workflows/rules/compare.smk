# Records this experiment in reports/history under a version: snakemake record --config version=v1
rule record:
    input:
        rules.aggregate.output,
    params:
        version=["--version", str(config["version"])] if config.get("version") else [],
    run:
        run_stage("workflows", "record", VIEW, *params.version)
