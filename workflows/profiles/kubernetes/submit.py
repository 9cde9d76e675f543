#!/usr/bin/env python3
"""Submit a job script of Snakemake with `kubectl`, and print the name of its Kubernetes job.

The environment names the image (DCREG_IMAGE), the claim of the shared volume (DCREG_CLAIM) and where all
pods mount it (DCREG_VOLUME). All variables DCREG_* are passed on.
"""

from __future__ import annotations

import json
import os
import subprocess
import sys
from collections.abc import Mapping
from pathlib import Path
from typing import Any

NEEDED = ("DCREG_IMAGE", "DCREG_CLAIM", "DCREG_VOLUME")
PROPERTIES = "# properties = "  # line of a job script, followed by JSON


def manifest(script: str, environment: Mapping[str, str]) -> dict[str, Any]:
    """Return the Kubernetes job of a job script, with the threads, memory and time that it states."""
    lines = Path(script).read_text(encoding="utf-8").splitlines()
    stated = next(line for line in lines if line.startswith(PROPERTIES))
    properties = json.loads(stated.removeprefix(PROPERTIES))
    memory, minutes = (properties["resources"][name] for name in ("mem_mb", "runtime"))
    share = {"cpu": str(properties["threads"]), "memory": f"{memory}Mi"}
    passed = {name: value for name, value in environment.items() if name.startswith("DCREG_")}
    container = {
        "name": "job",
        "image": environment["DCREG_IMAGE"],
        "command": ["/bin/sh", script],
        "env": [{"name": name, "value": value} for name, value in sorted(passed.items())],
        "resources": {"requests": share, "limits": share},
        "volumeMounts": [{"name": "shared", "mountPath": environment["DCREG_VOLUME"]}],
    }
    volume = {
        "name": "shared",
        "persistentVolumeClaim": {"claimName": environment["DCREG_CLAIM"]},
    }
    pod = {
        "restartPolicy": "Never",
        "securityContext": {"fsGroup": 1000},  # of the user of the image
        "containers": [container],
        "volumes": [volume],
    }
    labels = {"app": "dcreg"}
    return {
        "apiVersion": "batch/v1",
        "kind": "Job",
        "metadata": {"generateName": "dcreg-", "labels": labels},
        "spec": {
            "backoffLimit": 0,  # Snakemake tries again
            "activeDeadlineSeconds": 60 * minutes,
            "ttlSecondsAfterFinished": 86400,
            "template": {"metadata": {"labels": labels}, "spec": pod},
        },
    }


def main() -> None:
    missing = [name for name in NEEDED if not os.environ.get(name)]
    if missing:
        sys.exit(f"error: {missing[0]} is not set; docs/clusters.md explains what it names")
    job = json.dumps(manifest(sys.argv[1], os.environ))
    command = ["kubectl", "create", "--filename", "-", "--output", "name"]
    sys.exit(subprocess.run(command, input=job, text=True).returncode)


if __name__ == "__main__":
    main()
