"""Archives of results: all runs behind the ledger in a few files, one folder per version.

====================================== =======================================================
``archive.json``                       version, schema, hash of the lock file, experiments
``runs.parquet``                       all columns of ``tables/runs`` (`workflows.records`)
``traces.parquet``                     bound histories, at most `tables.STORED_EVENTS` events a run
``experiments/NAME/provenance.json``   config, options, cards, machine, versions of a run
``experiments/NAME/overlays.json.gz``  points and poses of the runs that a report shows
``experiments/NAME/clouds.parquet``    thinned clouds of its instances, as far as they fit
``experiments/NAME/needs.json``        blocks of collected evidence, from which a campaign continues
``bounds/NAME.parquet``                tables of the study of bounds
``bounds/provenance.json``             its machine, commit, and versions
``ro-crate-metadata.json``             the same facts for machines (RO-Crate)
``checksums.sha256``                   of every other file, for ``sha256sum --check``
====================================== =======================================================
"""
