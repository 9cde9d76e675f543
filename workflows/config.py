"""Experiments: YAML files in ``workflows/configs``, checked before anything runs."""

from __future__ import annotations

import math
import os
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Annotated, Any, NamedTuple

from pydantic import Field, ValidationError

from baselines import registry
from baselines.contract import Limits
from data import registry as data
from data.parameters import explain, key_path
from dcreg.problem import suggestion
from workflows import CHECKOUT, shown
from workflows.compose import EMBEDDED, QUICK, TIER, ConfigError, has_quick_part, read
from workflows.embedded import with_stand_ins
from workflows.grid import DatasetSettings, Model, check_datasets, check_size, check_tier
from workflows.idle import idle_limits, idle_points, stops_at_assignments
from workflows.parts import Part, part_of

CONFIGS = CHECKOUT / "workflows" / "configs"
Name = Annotated[str, Field(pattern=r"^[A-Za-z0-9][A-Za-z0-9._+-]*$", max_length=100)]
Seconds = Annotated[float, Field(gt=0, le=1e7)]


class LimitSettings(Part):
    """Limits of one run. A worker without an answer is killed some time after ``time_s``."""

    time_s: Seconds = 10.0
    # Of the whole worker, including its libraries; below 100 none could start.
    memory_mb: Annotated[int, Field(ge=100, le=10**8)] = 2048
    nodes: Annotated[int, Field(gt=0, le=10**15)] | None = None
    # Of methods that solve exact assignments: a measure of work, whatever machine and language.
    assignments: Annotated[int, Field(gt=0, le=10**15)] | None = None
    safety_s: Seconds | None = (
        None  # replaces time_s for methods that stop at the limit `assignments`
    )
    threads: Annotated[int, Field(gt=0, le=1024)] = 1
    warm_up_s: Seconds = 300.0  # imports and JIT compilation, once per worker

    @property
    def kill_after_s(self) -> float:
        """Seconds until a worker is killed; a method that keeps the limit answers before."""
        return 1.5 * self.time_s + 1.0

    def of_run(self) -> Limits:
        """Return the limits of a run, as given to the method."""
        return Limits(self.time_s, self.nodes, self.memory_mb, self.threads, self.assignments)


class MethodSettings(Part):
    """One line of the figures: a method of ``baselines/`` with its options and n_inliers."""

    name: Name  # of the line and of its folder of results
    baseline: str
    label: str = ""  # in figures; default: the card's name
    options: dict[str, Any] = Field(default={})
    # The solver receives n_inliers = round(ratio * true number), as in the paper, with 1 and 0.5.
    n_inliers_ratio: Annotated[float, Field(gt=0, le=2)] = 1.0
    n_points: Annotated[int, Field(ge=3)] | None = (
        None  # per cloud, farthest-point sampling; default: all
    )
    models: Annotated[list[Model], Field(min_length=1)] | None = (
        None  # that it is run on; default: all
    )
    limits: dict[str, float | None] = Field(default={})  # overrides of the experiment's limits


_AXES_HELP = "give AXIS=VALUE,VALUE with a known axis"


class Selection(Part):
    """A part of the grid, selected on the command line; an empty list selects everything."""

    methods: list[str] = Field(default=[])
    datasets: list[str] = Field(default=[])
    shapes: list[str] = Field(default=[])
    tests: list[str] = Field(default=[])
    levels: list[float] = Field(default=[])
    trials: list[int] = Field(default=[])


class Experiment(Part):
    name: Name
    title: str = ""
    seed: int = 0  # of methods that draw random numbers; instances depend on their axes only
    chunk_size: Annotated[int, Field(gt=0)] = 50  # instances per solve job
    limits: LimitSettings = LimitSettings()
    datasets: Annotated[list[DatasetSettings], Field(min_length=1)]
    methods: Annotated[list[MethodSettings], Field(min_length=1)]
    # A setting is n_inliers_ratio, or an option that has a default other than null and an effect. Methods
    # with the setting run once with each value.
    vary: dict[str, Annotated[list[int | float | str], Field(min_length=1)]] = Field(default={})

    def method(self, name: str) -> MethodSettings:
        return next(method for method in self.methods if method.name == name)

    def limits_of(self, method: MethodSettings) -> LimitSettings:
        return LimitSettings(**{**self.limits.model_dump(), **method.limits})


class Place(NamedTuple):
    """What the name of an experiment stands for: a config, its quick part, or a tier of either."""

    path: Path
    quick: bool = False
    n_points: int | None = None  # of the tier; None: as in the config
    embedded: bool = False  # on embedded shapes


def find(experiment: str) -> Place:
    """Return the config of an experiment, given by path or by name, such as ``demo``.

    ``paper2d-quick`` is the quick part of a config, ``paper2d-40`` its tier of 40 points per shape, and
    ``paper2d-40-quick`` the quick part of the tier. The ending ``-embedded`` replaces the shapes.
    """
    if experiment.endswith(EMBEDDED):
        return find(experiment.removesuffix(EMBEDDED))._replace(embedded=True)
    path = Path(experiment)
    if path.suffix in (".yaml", ".yml") and path.is_file():
        return Place(path)
    known = sorted(file.stem for file in CONFIGS.glob("*.yaml"))
    name = experiment.removesuffix(QUICK)
    if name not in known and (tier := TIER.fullmatch(name)) and tier["whole"] in known:
        n_points = int(tier["points"])
        return Place(CONFIGS / f"{tier['whole']}.yaml", name != experiment, n_points)
    if name in known:
        return Place(CONFIGS / f"{name}.yaml", name != experiment)
    if path.suffix in (".yaml", ".yml") or len(path.parts) > 1:
        raise ConfigError(
            f"{experiment}: no such config file in {Path.cwd()}; correct the path, or give one of "
            f"{', '.join(known)}"
        )
    raise ConfigError(f"no experiment {experiment!r}{suggestion(experiment, known)}")


def origin(experiment: str) -> str:
    """Return the name of a config of the checkout, or the path of another one."""
    place = find(experiment)
    path = place.path.resolve()
    if path.parent != CONFIGS:
        return shown(path)
    tier = "" if place.n_points is None else f"-{place.n_points}"
    return path.stem + tier + QUICK * place.quick + EMBEDDED * place.embedded


def load(experiment: str) -> Experiment:
    """Read an experiment by name or path and check it against cards and datasets.

    The quick part of a whole experiment is checked as well.

    Raises
    ------
    ConfigError
        Lists all problems.
    """
    place = find(experiment)
    search_next_to(place.path)
    settings = _load(place)
    if not place.quick and has_quick_part(place.path):
        try:
            _load(place._replace(quick=True))
        except ConfigError as error:
            remedy = "this is in the quick part; correct it, or remove the key quick"
            raise ConfigError(f"{error}\n{shown(place.path)}: {remedy}") from error
    return settings


def search_next_to(path: Path) -> None:
    """Search the folders ``baselines`` and ``data`` next to a config for methods and datasets.

    Child processes inherit the two environment variables.
    """
    for variable, name in ((registry.SEARCH_PATH, "baselines"), (data.SEARCH_PATH, "data")):
        folder = path.resolve().parent / name
        known = [entry for entry in os.environ.get(variable, "").split(os.pathsep) if entry]
        if folder.is_dir() and folder != CHECKOUT / name and str(folder) not in known:
            os.environ[variable] = os.pathsep.join([*known, str(folder)])


def with_methods(settings: Experiment, names: Iterable[str]) -> Experiment:
    """Add methods by name, with their default options, to an experiment that lacks them.

    Unknown names are ignored here; the check of the selection reports them.
    """
    known = {method.name for method in settings.methods}
    missing = [name for name in dict.fromkeys(names) if name not in known]
    added = [
        _with_its_limits(settings, MethodSettings(name=name, baseline=name))
        for name in missing
        if name in registry.names()
    ]
    return settings.model_copy(update={"methods": [*settings.methods, *added]})


def _load(place: Place) -> Experiment:
    """Read and check the experiment of a config, its quick part, or a tier."""
    path = place.path
    content = read(path, place.quick, place.n_points)
    if place.embedded:
        content = with_stand_ins(content)
    try:
        settings = Experiment.model_validate(content)
    except ValidationError as error:
        raise _config_error(path, [_explain(problem) for problem in error.errors()]) from error
    if place.n_points is not None and (problems := [*check_tier(settings.datasets)]):
        raise _config_error(path, problems)
    problems = [
        *_check_name(settings, path),
        *_check_methods(settings),
        *check_datasets(settings.datasets),
    ]
    problems = problems or [*_check_variations(settings)]
    if not problems:
        methods = [_with_its_limits(settings, method) for method in _varied(settings)]
        settings = settings.model_copy(update={"methods": methods, "vary": {}})
        problems = [
            *_check_labels(settings),
            *(t for m in methods for t in idle_points(m.name, m.baseline, m.options, m.n_points)),
            *check_size(settings.datasets, [method.models for method in settings.methods]),
        ]
    if problems:
        raise _config_error(path, problems)
    return settings


def parse_selection(texts: Iterable[str]) -> Selection:
    """Return a `Selection` from texts such as ``tests=noise,deformation``; none selects everything."""
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


def _check_name(settings: Experiment, path: Path) -> Iterable[str]:
    """Yield a name that belongs to a config of the checkout: results are stored by name."""
    namesake = CONFIGS / f"{settings.name}.yaml"
    if namesake.is_file() and namesake != path.resolve():
        yield f"name: {settings.name!r} is the name of {shown(namesake)}; give another name"


def _check_methods(settings: Experiment) -> Iterable[str]:
    known = registry.names()
    for index, method in enumerate(settings.methods):
        key = f"methods[{index}]"
        if method.baseline not in known:
            yield f"{key}.baseline: no method {method.baseline!r}{suggestion(method.baseline, known)}"
            continue
        try:
            card = registry.read_card(method.baseline)
        except registry.BaselineError as error:
            yield f"{key}.baseline: {error}"
            continue
        parameters = card.parameters
        if method.n_inliers_ratio != 1.0 and not card.uses_n_inliers:
            yield (
                f"{key}.n_inliers_ratio: {method.n_inliers_ratio:g} has no effect, as "
                f"{method.baseline} does not use n_inliers; remove it"
            )
        unknown = sorted(set(method.options) - set(parameters))
        for option in unknown:
            yield f"{key}.options.{option}: unknown option{suggestion(option, parameters)}"
        if method.options and not unknown:
            yield from _check_options(key, method)
        try:
            limits = settings.limits_of(method).model_dump()
            stops = stops_at_assignments(method.baseline, method.options)
            for text in idle_limits(method.limits, limits, stops=stops):
                yield f"{key}.limits.{text}"
        except ValidationError as error:
            for problem in error.errors():
                problem["loc"] = ("limits", *problem["loc"])
                yield f"{key}.{_explain(problem)}"
    has_limit = settings.limits.assignments or any(
        m.limits.get("assignments") for m in settings.methods
    )
    if settings.limits.safety_s is not None and not has_limit:
        yield "limits.safety_s: has no effect without a limit on assignments; remove it"


def _with_its_limits(settings: Experiment, method: MethodSettings) -> MethodSettings:
    """Return the method with its limit: assignments and `safety_s`, or `time_s`."""
    limits = settings.limits_of(method)
    if limits.assignments is None:
        return method
    own: dict[str, float | None] = {"assignments": None}
    if stops_at_assignments(method.baseline, method.options):
        own = {} if limits.safety_s is None else {"time_s": limits.safety_s}
    return method.model_copy(update={"limits": {**method.limits, **own}})


def _check_labels(settings: Experiment) -> Iterable[str]:
    labels = [method.name for method in settings.methods]
    for label in sorted({label for label in labels if labels.count(label) > 1}):
        yield f"methods: name {label!r} is used {labels.count(label)} times; give different names"


def _varied(settings: Experiment) -> Iterable[MethodSettings]:
    """Yield the methods; each with a setting of ``vary`` once per value."""
    for method in settings.methods:
        takes = [key for key in settings.vary if _takes(method, key)]
        if not takes:
            yield method
        for key in takes:
            yield from (_with_setting(method, key, value) for value in settings.vary[key])


def _takes(method: MethodSettings, key: str) -> bool:
    card = registry.read_card(method.baseline)
    if key == "n_inliers_ratio":
        has_it = card.uses_n_inliers and key not in method.model_fields_set
    else:
        has_it = card.parameters.get(key) is not None and key not in method.options
    return has_it and key not in registry.idle_options(method.baseline, method.options)


def _with_setting(method: MethodSettings, key: str, value: float | str) -> MethodSettings:
    text = isinstance(value, str)
    label = method.label or registry.read_card(method.baseline).display_name
    factors = {"n_inliers_ratio": "n_p ×", "noise_factor": "noise_factor ×"}
    ours = "our " * (key == "front_end" and value != "oracle")
    shown_value = f"{ours}{value}" if text else f"{factors.get(key, f'{key} =')} {value:g}"
    name = f"{method.name}-{value if text else f'{key}{value:g}'}"
    changed = {"name": name, "label": with_note(label, shown_value)}
    if key == "n_inliers_ratio":
        return MethodSettings(**{**method.model_dump(), **changed, key: value})
    options = {**method.options, key: value}
    return MethodSettings(**{**method.model_dump(), **changed, "options": options})


def with_note(label: str, note: str) -> str:
    """Return a label with a note in its last parentheses."""
    if not note:
        return label
    return f"{label[:-1]}, {note})" if label.endswith(")") else f"{label} ({note})"


def _check_variations(settings: Experiment) -> Iterable[str]:
    """Yield settings that no method has, and values that a method refuses."""
    for key, values in settings.vary.items():
        takers = [method for method in settings.methods if _takes(method, key)]
        if not takers:
            yield f"vary.{key}: no method has it; name n_inliers_ratio or an option, or remove it"
        for method, value in ((method, value) for method in takers for value in values):
            try:
                varied = _with_setting(method, key, value)
            except ValidationError as error:
                yield from (f"vary.{_explain(problem)}" for problem in error.errors())
            else:
                yield from _check_options(f"vary.{key}, method {method.name}", varied)


def _check_options(key: str, method: MethodSettings) -> Iterable[str]:
    """Yield values that the method refuses, and numbers that are not finite."""
    for option, value in method.options.items():
        if isinstance(value, float) and not math.isfinite(value):
            yield f"{key}.options.{option}: {value} is not finite; give a number"
    try:
        registry.load(method.baseline, **method.options)
    except registry.BaselineError as error:
        yield f"{key}.options: {error}"
    except ImportError:
        pass  # not installed here: its runs end as unavailable


def _config_error(path: Path, problems: Sequence[str]) -> ConfigError:
    return ConfigError("\n".join(f"{shown(path)}: {problem}" for problem in problems))


def _explain(problem: Any) -> str:
    """Describe one pydantic problem of a config."""
    key = key_path(problem["loc"])
    if problem["type"] in ("too_short", "list_type") and key.endswith((".shapes", ".models")):
        return f"{key}: is {problem['input']!r}; list at least one, or leave it out for all"
    return explain(problem, _keys_at)


def _keys_at(location: Sequence[str | int]) -> Iterable[str]:
    """Return the keys that a config may have at this location."""
    model: Any = Experiment
    for part in location:
        if isinstance(part, str) and part in getattr(model, "model_fields", {}):
            model = part_of(model.model_fields[part].annotation)
    return getattr(model, "model_fields", {})
