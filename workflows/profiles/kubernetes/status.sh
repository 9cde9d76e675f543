#!/bin/sh
# Print the state of a Kubernetes job: running, success or failed. A deleted job has failed.
conditions='{.metadata.name} {.status.conditions[?(@.status=="True")].type}'
if ! found=$(kubectl get "$1" --ignore-not-found --output "jsonpath=$conditions"); then
  found=unreachable
fi
case $found in
  *Complete*) echo success ;;
  *Failed* | '') echo failed ;;
  *) echo running ;;
esac
