"""The files that commands write, as groups of options: see `dcreg.cli.options`."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

from dcreg.cli import output
from dcreg.cli.options import flag
from dcreg.names import CLOUD_SUFFIXES


class Files:
    """Files whose options are fields."""

    @property
    def paths(self) -> dict[str, Path | None]:
        """The file of each option."""
        return {flag(name): path for name, path in vars(self).items()}


@dataclass
class AnswerFiles(Files):
    """The files of the answer to a question.

    Attributes
    ----------
    json_path : OUT
        Write the answer; '-' is standard output.
    plot_path : OUT.html
        Write a page with the clouds at each pose.
    """

    json_path: Path | None = None
    plot_path: Path | None = None

    def check(self, *inputs: str | None) -> None:
        """Refuse before the search what could not be written."""
        output.check_outputs(self.paths, *inputs)
        output.check_figure(self.plot_path, [".html"])


@dataclass
class BatchFiles:
    """The files that a batch writes.

    Attributes
    ----------
    out_path : OUT.csv
        Write a row for each pair: status, pose, bounds or error. The file is rewritten after each pair.
    graph_path : OUT.g2o
        Write the poses as a pose graph for g2o. In 2D it needs --scale-range 1 1.
    """

    out_path: Path
    graph_path: Path | None = None

    def check(self, *inputs: str | None) -> None:
        """Refuse before the searches what could not be written."""
        output.check_suffix("--out", self.out_path, [".csv"])
        output.check_suffix("--graph", self.graph_path, [".g2o"])
        output.check_outputs({"--out": self.out_path, "--graph": self.graph_path}, *inputs)


@dataclass
class SearchFiles(Files):
    """The files of the search of a registration.

    Attributes
    ----------
    certificate_path : OUT.npz
        Write a certificate for `dcreg verify`. The search then continues to its limits, as with --prove.
    checkpoint_path : FILE.npz
        Save the state of the search every two minutes and at its end. If the file exists, the search
        continues from it.
    """

    certificate_path: Path | None = None
    checkpoint_path: Path | None = None


@dataclass
class ProofFiles(SearchFiles, AnswerFiles):
    """The files of the answer to a question and of its search."""


@dataclass
class Outputs(Files):
    """The files of one registration.

    Attributes
    ----------
    json_path : OUT
        Write the result; '-' is standard output.
    trace_path : OUT.jsonl
        Write the bound history.
    plot_path : OUT.html
        Write a page with figures.
    output_path : OUT
        Write the source moved by the final pose: {cloud_suffixes}. In the format of the source, its other
        attributes are kept, and normals are rotated.
    """

    json_path: Path | None = None
    trace_path: Path | None = None
    plot_path: Path | None = None
    output_path: Path | None = None

    def check(self, paths: dict[str, Path | None], *inputs: str | None) -> None:
        """Refuse before the search what could not be written; `paths` are those of all options."""
        output.check_outputs(paths, *inputs)
        output.check_figure(self.plot_path, [".html"])
        output.check_suffix("--output", self.output_path, CLOUD_SUFFIXES)
