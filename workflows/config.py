"""What an experiment is: one YAML file in ``workflows/configs``, checked before anything runs."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Annotated, Any, Literal, get_args

import yaml
from pydantic import BaseModel, ConfigDict, Field, ValidationError, field_validator

from dcreg.problem import suggestion
from workflows import CHECKOUT, UserError, methods

CONFIGS = CHECKOUT / "workflows" / "configs"
Name = Annotated[str, Field(pattern=r"^[A-Za-z0-9][A-Za-z0-9._+-]*$")]
Positive = Annotated[float, Field(gt=0)]


class ConfigError(UserError):
    """The experiment cannot be run; the message names file, key, value and remedy."""


class Part(BaseModel):
    model_config = ConfigDict(extra="forbid", frozen=True)


class LimitSettings(Part):
    """What one run may use. A worker that has not answered well after ``time_s`` is killed."""

    time_s: Positive = 10.0
    memory_mb: Annotated[int, Field(gt=0)] = 2048  # of the whole worker, its libraries included
    nodes: Annotated[int, Field(gt=0)] | None = None
    threads: Annotated[int, Field(gt=0)] = 1
    warm_up_s: Positive = 300.0  # imports and JIT compilation, once per worker

    @property
    def kill_after_s(self) -> float:
        """A method that obeys the limit itself has this long to say so."""
        return 1.5 * self.time_s + 1.0


class DatasetSettings(Part):
    """One dataset and the grid of tests × levels × trials drawn from it."""

    dataset: str
    shapes: list[str] = []  # all of the dataset's, when empty
    tests: Annotated[dict[str, list[float]], Field(min_length=1)]
    trials: Annotated[int, Field(gt=0)] = 1
    n_points: Annotated[int, Field(ge=3)] | None = None

    @field_validator("tests")
    @classmethod
    def _levels_differ(cls, tests: dict[str, list[float]]) -> dict[str, list[float]]:
        for test, levels in tests.items():
            if not levels or len(set(levels)) < len(levels):
                raise ValueError(f"{test}: give one or more different levels, not {levels}")
        return tests


class MethodSettings(Part):
    """One line of the figures: a method of ``baselines/`` with options and prior."""

    name: Name  # names the line and its folder of results
    baseline: str
    label: str = ""  # shown in figures; by default the card's name
    options: dict[str, Any] = {}
    # The solver is told round(ratio * true count) pairs, as in the paper, which derives the prior
    # from the truth: 1 and 0.5 there.
    n_inliers_ratio: Annotated[float, Field(gt=0, le=2)] = 1.0
    models: list[Literal["similarity2d", "rigid3d"]] = []  # instances it is asked to treat; all
    limits: dict[str, float | None] = {}  # overrides of the experiment's limits


_AXES_HELP = "give AXIS=VALUE,VALUE with a known axis"


class Selection(Part):
    """A part of the grid, chosen on the command line; an empty list selects everything."""

    methods: list[str] = []
    datasets: list[str] = []
    shapes: list[str] = []
    tests: list[str] = []
    levels: list[float] = []
    trials: list[int] = []


class Experiment(Part):
    name: Name
    title: str = ""
    seed: int = 0  # of methods that draw random numbers; instances depend on their axes only
    chunk_size: Annotated[int, Field(gt=0)] = 50  # instances per solve job
    limits: LimitSettings = LimitSettings()
    datasets: Annotated[list[DatasetSettings], Field(min_length=1)]
    methods: Annotated[list[MethodSettings], Field(min_length=1)]

    def method(self, name: str) -> MethodSettings:
        return next(method for method in self.methods if method.name == name)

    def limits_of(self, method: MethodSettings) -> LimitSettings:
        return LimitSettings(**{**self.limits.model_dump(), **method.limits})


def find(experiment: str) -> Path:
    """Path of a config given by name (``demo``) or by path."""
    path = Path(experiment)
    if path.suffix in (".yaml", ".yml") and path.is_file():
        return path
    known = sorted(file.stem for file in CONFIGS.glob("*.yaml"))
    if experiment in known:
        return CONFIGS / f"{experiment}.yaml"
    raise ConfigError(f"no experiment {experiment!r}{suggestion(experiment, known)}")


def origin(experiment: str) -> str:
    """Name of a config of the checkout, or path of another one: what finds it again."""
    path = find(experiment).resolve()
    return path.stem if path.parent == CONFIGS else _shown(path)


def load(experiment: str) -> Experiment:
    """Read an experiment by name or path and check all of it against cards and datasets.

    Raises
    ------
    ConfigError
        Lists everything that is wrong, not only the first thing.
    """
    path = find(experiment)
    try:
        content = yaml.load(path.read_text(encoding="utf-8"), _StrictLoader)
    except yaml.YAMLError as error:
        raise ConfigError(f"{_shown(path)}: not valid YAML: {error}") from error
    if not isinstance(content, dict):
        raise ConfigError(f"{_shown(path)}: must be a mapping of keys to values")
    try:
        settings = Experiment(**content)
    except ValidationError as error:
        raise _config_error(path, [_explain(problem) for problem in error.errors()]) from error
    if problems := [*_check_methods(settings), *_check_datasets(settings)]:
        raise _config_error(path, problems)
    return settings


def parse_selection(texts: Iterable[str]) -> Selection:
    """A `Selection` from texts such as ``tests=noise,deformation``; an empty list selects all."""
    chosen: dict[str, list[str]] = {}
    for text in texts:
        axis, separator, values = text.partition("=")
        if not separator or axis not in Selection.model_fields:
            raise ConfigError(
                f"selection {text!r}: {_AXES_HELP}{suggestion(axis, Selection.model_fields)}"
            )
        chosen[axis] = [value.strip() for value in values.split(",") if value.strip()]
    try:
        return Selection.model_validate(chosen)
    except ValidationError as error:
        raise ConfigError(
            "\n".join(f"selection {_explain(problem)}" for problem in error.errors())
        ) from error


def _check_methods(settings: Experiment) -> Iterable[str]:
    from baselines.registry import BaselineError

    labels = [method.name for method in settings.methods]
    for label in sorted({label for label in labels if labels.count(label) > 1}):
        yield f"methods: name {label!r} is used {labels.count(label)} times; give different names"
    known = methods.names()
    for index, method in enumerate(settings.methods):
        key = f"methods[{index}]"
        if method.baseline not in known:
            yield f"{key}.baseline: no method {method.baseline!r}{suggestion(method.baseline, known)}"
            continue
        try:
            parameters = methods.card(method.baseline).parameters
        except BaselineError as error:
            yield f"{key}.baseline: {error}"
            continue
        for option in sorted(set(method.options) - set(parameters)):
            yield f"{key}.options.{option}: unknown option{suggestion(option, parameters)}"
        try:
            settings.limits_of(method)
        except ValidationError as error:
            for problem in error.errors():
                problem["loc"] = ("limits", *problem["loc"])
                yield f"{key}.{_explain(problem)}"


def _check_datasets(settings: Experiment) -> Iterable[str]:
    from data import registry
    from data.contract import RecordedDataset
    from workflows.disturb import DISTURBANCES

    known = registry.datasets()
    for index, entry in enumerate(settings.datasets):
        key = f"datasets[{index}]"
        if entry.dataset not in known:
            yield f"{key}.dataset: no dataset {entry.dataset!r}{suggestion(entry.dataset, known)}"
            continue
        dataset = known[entry.dataset]
        for shape in entry.shapes:
            if shape not in dataset.shapes():
                yield f"{key}.shapes: no shape {shape!r}{suggestion(shape, dataset.shapes())}"
        recorded = dataset.tests() if isinstance(dataset, RecordedDataset) else {}
        tests = recorded or DISTURBANCES
        for test, levels in entry.tests.items():
            if test not in tests:
                yield f"{key}.tests.{test}: no such test{suggestion(test, tests)}"
            elif recorded:
                axis = recorded[test]
                for level in sorted(set(levels) - set(axis.levels)):
                    yield f"{key}.tests.{test}: no level {level:g}; it has {list(axis.levels)}"
                if entry.trials > axis.n_trials:
                    yield f"{key}.trials: {test} has {axis.n_trials} trials, not {entry.trials}"


def _config_error(path: Path, problems: Sequence[str]) -> ConfigError:
    return ConfigError("\n".join(f"{_shown(path)}: {problem}" for problem in problems))


def _explain(problem: Any) -> str:
    """One pydantic problem as ``key.path: what is wrong; remedy``."""
    location = problem["loc"]
    key = "".join(f"[{part}]" if isinstance(part, int) else f".{part}" for part in location)
    key = key.removeprefix(".")
    if problem["type"] == "extra_forbidden":
        return f"{key}: unknown key{suggestion(str(location[-1]), _keys_at(location[:-1]))}"
    if problem["type"] == "missing":
        return f"{key}: missing; add it"
    return f"{key}: {problem['msg']}, is {problem['input']!r}"


def _keys_at(location: Sequence[str | int]) -> Iterable[str]:
    """Keys that a config may have at this place."""
    model: Any = Experiment
    for part in location:
        if isinstance(part, str) and part in getattr(model, "model_fields", {}):
            model = _part_of(model.model_fields[part].annotation)
    return getattr(model, "model_fields", {})


def _part_of(annotation: Any) -> Any:
    """The `Part` inside an annotation such as ``Annotated[list[Part], ...]``."""
    if isinstance(annotation, type) and issubclass(annotation, Part):
        return annotation
    return next((part for inner in get_args(annotation) if (part := _part_of(inner))), None)


def _shown(path: Path) -> str:
    path = path.resolve()
    return str(path.relative_to(CHECKOUT) if path.is_relative_to(CHECKOUT) else path)


class _StrictLoader(yaml.SafeLoader):
    """YAML in which a key given twice is an error, not a silent override."""

    def construct_mapping(self, node: Any, deep: bool = False) -> dict[Any, Any]:
        seen = set()
        for key_node, _ in node.value:
            key = self.construct_object(key_node, deep=True)
            if key in seen:
                raise yaml.constructor.ConstructorError(
                    None, None, f"key {key!r} is given twice", key_node.start_mark
                )
            seen.add(key)
        return super().construct_mapping(node, deep)
