#!/bin/sh
# Delete Kubernetes jobs with their pods.
exec kubectl delete --ignore-not-found --wait=false "$@"
