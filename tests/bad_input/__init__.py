"""Input that must be refused: one table of cases for each area, and the command that tries them all."""

from tests.bad_input import arguments, configs, files, library, proofs

AREAS = {
    "files": files.CASES,
    "arguments": arguments.ARGUMENTS,
    "outputs": arguments.OUTPUT_CASES,
    "candidates": proofs.CANDIDATES,
    "certificates": proofs.CERTIFICATES,
    "library": library.CASES,
    "configs": configs.CASES,
}
