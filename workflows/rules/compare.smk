# Records the small tables of this experiment under a version: snakemake record --config version=v1
rule record:
    input:
        rules.aggregate.output,
    params:
        version=f"--version '{config['version']}'" if config.get("version") else "",
    shell:
        "{STAGE} record {VIEW} {params.version}"
