"""Rules on the card and the code of a method."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

from baselines import registry
from baselines.conformance.candidate import (
    MODELS,
    BrokenRuleError,
    Candidate,
    easy_instance,
    require,
)


def card_is_complete(method: Candidate) -> None:
    """The card states name, summary, citation, licence, models, and how to get what it requires."""
    card = method.card
    for key in ("display_name", "summary", "citation", "licence", "models"):
        value = getattr(card, key)
        is_empty = not (value.strip() if isinstance(value, str) else value)
        require(not is_empty, f"card.yaml: {key} is empty; fill it in")
    stated = card.how_to_get or not card.requires
    require(stated, f"card.yaml: requires {card.requires}, but how_to_get is empty; fill it in")
    if card.provides_bounds != (card.certifies != "nothing"):
        raise BrokenRuleError(
            f"card.yaml: provides_bounds is {card.provides_bounds}, but certifies is "
            f"{card.certifies!r}; correct one of them"
        )
    if card.provenance == "reconstruction":
        marked = "reconstruction" in card.summary.lower()
        marked = marked and "(reconstructed)" in card.display_name
        require(
            marked,
            "card.yaml: a reconstruction says so in its summary, and its display_name ends with "
            "(reconstructed); a method of your own has the provenance own",
        )


def look_and_name_are_unique(method: Candidate) -> None:
    """Its displayed name, and its colour and marker together, differ from those of all other methods."""
    card = method.card
    look = card.color.lower(), card.marker
    for name in registry.names():
        if name == method.name:
            continue
        try:
            other = registry.read_card(name)
        except registry.BaselineError:
            continue  # another method that is broken
        require(
            other.display_name.lower() != card.display_name.lower(),
            f"card.yaml: display_name {card.display_name!r} is that of {name}; choose another",
        )
        require(
            (other.color.lower(), other.marker) != look,
            f"card.yaml: color {card.color!r} with marker {card.marker!r} is that of {name}; choose "
            "another colour or marker",
        )


def parameters_are_accepted(method: Candidate) -> None:
    """The adapter accepts the defaults of its card."""
    card, idle = method.card, method.load().idle_options()
    given = {key: value for key, value in card.parameters.items() if key not in idle}
    options = method.load(**given).options
    require(
        options == card.parameters,
        f"with the defaults of the card, the adapter has the options {options}; keep self.options",
    )


def every_parameter_is_read(method: Candidate) -> None:
    """The code reads every parameter of the card."""
    paths = registry.code_of(method.name, method.root)
    code = "".join(path.read_text("utf-8") for path in paths if path.suffix == ".py")
    for option in method.card.parameters:
        require(
            f'"{option}"' in code or f"'{option}'" in code,
            f'card.yaml: no code reads self.options["{option}"]; use the parameter, or remove it',
        )


def numbers_have_ranges(method: Candidate) -> None:
    """Every numerical parameter has a range that contains its default."""
    card = method.card
    for option, default in card.parameters.items():
        entries = default if isinstance(default, list) else [default]
        if any(type(entry) in (int, float) for entry in entries):  # no flags
            require(
                option in card.ranges,
                f"card.yaml: parameter {option} has no range; add it, as in "
                f"ranges: {{{option}: {{above: 0}}}}",
            )
    for option, admitted in card.ranges.items():
        require(
            (admitted.above is None) != (admitted.least is None),
            f"card.yaml: ranges.{option}: give either above or least",
        )
        require(
            not admitted.admits(-1), f"card.yaml: ranges.{option}: admits -1; no option may be < 0"
        )


def options_without_effect_are_refused(method: Candidate) -> None:
    """An option that `idle_options` names is refused with its reason."""
    card, idle = method.card, method.load().idle_options()
    for option, reason in idle.items():
        if option in card.parameters:
            problem = _refusal(method, {option: card.parameters[option]})
            require(
                f"{option} = " in problem and f"{reason}; leave" in problem,
                f"option {option} has no effect {reason}, but is not refused; call super().__init__",
            )


def unknown_options_are_refused(method: Candidate) -> None:
    """An option that the card does not have is refused."""
    problem = _refusal(method, {"no_such_option": 1})
    require("no_such_option" in problem, "an unknown option is accepted; call super().__init__")


def _refusal(method: Candidate, options: dict[str, Any]) -> str:
    try:
        method.load(**options)
    except registry.BaselineError as error:
        return str(error)
    return ""


def available_or_says_how_to_get_it(method: Candidate) -> None:
    """A method that cannot run here says why, and how to get it."""
    loaded = method.load()
    reason = loaded.available()
    if reason is None:
        return
    remedy = loaded.card.how_to_get
    require(remedy, "card.yaml: how_to_get is empty, but the method is not available; fill it in")
    ends = reason.strip().endswith(remedy) or "front end" in reason
    require(
        ends and len(reason) > len(remedy),
        f"available() returns {reason!r}; give the reason and how_to_get",
    )


def other_models_are_unsupported(method: Candidate) -> None:
    """Models that the card does not list are refused with a reason."""
    loaded = method.load()
    for model in MODELS:
        reason = loaded.supports(easy_instance(model))
        require(
            (reason is None) == (model in loaded.card.models)
            and (reason is None or model in reason),
            f"supports() returns {reason!r} for {model}, but the card lists {loaded.card.models}",
        )


RULES: tuple[Callable[[Candidate], None], ...] = (
    card_is_complete, look_and_name_are_unique, parameters_are_accepted, every_parameter_is_read,
    numbers_have_ranges, options_without_effect_are_refused, unknown_options_are_refused,
    available_or_says_how_to_get_it, other_models_are_unsupported,
)  # fmt: skip
