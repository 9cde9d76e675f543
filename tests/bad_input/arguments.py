"""Arguments and options of the command line, and files to write."""

from __future__ import annotations

from collections.abc import Callable, Iterator

from tests.bad_input.case import Case, register, sweep

Call = Callable[..., list[str]]

NUMBERS = {  # options that both commands have: value, what the message shows, remedy
    "rel_gap": {
        "-1": ("--rel-gap: -1.0", "give 0 or a positive number"),
        "nan": ("--rel-gap: nan", "give 0 or a positive number"),
        "1": ("--rel-gap: 1.0 is not below 1", "give a share of the upper bound"),
        "1%": ("'1%' is not a number", "give one such as"),
    },
    "abs_gap": {
        "-1": ("--abs-gap: -1.0", "give 0 or a positive number"),
        "nan": ("--abs-gap: nan", "give 0 or a positive number"),
        "inf": ("--abs-gap: inf", "give 0 or a positive number"),
        "small": ("'small' is not a number", "give one such as"),
        "1,5": ("'1,5' is not a number", "give one such as"),
    },
    "tol": {
        "-1": ("--tol: -1.0", "give a length in units of the target"),
        "nan": ("--tol: nan", "give a length in units of the target"),
        "inf": ("--tol: inf", "give a length in units of the target"),
        "1e200": ("--tol: 1e+200", "give a length in units of the target"),
        "1mm": ("'1mm' is not a number", "give one such as"),
    },
    "time_limit": {
        "0": ("--time-limit: 0.0", "give a positive number"),
        "-5": ("--time-limit: -5.0", "give a positive number"),
        "nan": ("--time-limit: nan", "give a positive number"),
        "-inf": ("--time-limit: -inf", "give a positive number"),
        "1h": ("'1h' is not a number", "give one such as"),
    },
    "node_limit": {
        "0": ("--node-limit: 0", "give a positive number"),
        "-3": ("--node-limit: -3", "give a positive number"),
        "1e3": ("'1e3' is not a whole number", "give one such as"),
        "2.5": ("'2.5' is not a whole number", "give one such as"),
        "many": ("'many' is not a whole number", "give one such as"),
    },
    "threads": {
        "0": ("--threads: 0", "give a positive number"),
        "-1": ("--threads: -1", "give a positive number"),
        "two": ("'two' is not a whole number", "give one such as"),
        "1.5": ("'1.5' is not a whole number", "give one such as"),
        "1000000": ("--threads: 1000000 threads are too many", "give at most"),
        "99999999999999999999": ("--threads: 99999999999999999999 threads are too many", "give at most"),
    },
    "bound": {
        "magic": ("--bound: 'magic'", "known: dc"),
        "tigth": ("--bound: 'tigth'", "known: dc"),
        "": ("--bound: ''", "known: dc"),
        "tight+": ("--bound: ''", "known: dc"),
        "tight+magic": ("--bound: 'magic'", "known: dc"),
    },
    "model": {
        "affine": ("--model: 'affine' is unknown", "known: rigid3d, similarity2d, similarity3d"),
        "rigid2d": ("--model: 'rigid2d' is unknown", "'rigid3d'"),
        "": ("--model: '' is unknown", "known: rigid3d, similarity2d, similarity3d"),
    },
    "start_box": {
        "magic": ("--start-box: 'magic' is unknown", "known: radius, stationary"),
        "radios": ("--start-box: 'radios'", "did you mean 'radius'"),
    },
    "memory_limit_mb": {
        "-1": ("--memory-limit-mb: -1.0", "give a positive number"),
        "nan": ("--memory-limit-mb: nan", "give a positive number"),
        "1GB": ("'1GB' is not a number", "give one such as"),
    },
    "n_inliers": {
        "lots": ("--n-inliers: 'lots' is not a number", "such as 40 or a fraction"),
        "0": ("--n-inliers: 0 pairs", "between 1 and 8"),
        "-2": ("--n-inliers: -2 pairs", "between 1 and 8"),
        "9": ("--n-inliers: 9 pairs", "between 1 and 8"),
        "99999999999999999999": ("--n-inliers: 99999999999999999999", "between 1 and 8"),
        "1.5": ("--n-inliers: the fraction 1.5", "between 1 and 8"),
        "0.0": ("--n-inliers: the fraction 0.0", "between 1 and 8"),
        "nan": ("--n-inliers: the fraction nan", "between 1 and 8"),
        "80%": ("--n-inliers: '80%'", "such as 40 or a fraction"),
    },
}  # fmt: skip
SCALES = {
    ("2", "1"): ("--scale-range: (2.0, 1.0)", "0 < low <= high"),
    ("0", "1"): ("--scale-range: (0.0, 1.0)", "0 < low <= high"),
    ("-1", "1"): ("--scale-range: (-1.0, 1.0)", "0 < low <= high"),
    ("nan", "1"): ("--scale-range: (nan, 1.0)", "0 < low <= high"),
    ("1", "inf"): ("--scale-range: (1.0, inf)", "0 < low <= high"),
    ("half", "1"): ("'half' is not a number", "give one such as"),
    ("1e-300", "1e300"): ("--scale-range: (1e-300, 1e+300)", "rescale one cloud"),
}
RANGES = {
    "0.3:1:0.1": ("--n-inliers: '0.3:1:0.1' mixes", "a fraction needs a decimal point"),
    "0.3:1.0": ("--n-inliers: '0.3:1.0' is not a range", "give one such as"),
    "9:6:1": ("--n-inliers: '9:6:1' is not a range", "give one such as"),
    "6:9:0": ("--n-inliers: '6:9:0' is not a range", "give one such as"),
    "6:9:-1": ("--n-inliers: '6:9:-1' is not a range", "give one such as"),
    "0.1:nan:0.1": ("--n-inliers: '0.1:nan:0.1' is not a range", "give one such as"),
    "1:2:3:4": ("--n-inliers: '1:2:3:4' is not a range", "give one such as"),
    "1:1000000000": ("is a range of 1000000000 numbers", "choose a step"),
    "0.1:1.0:0.00001": ("is a range of 90001 numbers", "choose a step"),
    ":": ("--n-inliers: '' is not a number", "such as 40"),
    ",": ("--n-inliers: the list is empty", "give at least one"),
    "4,9": ("--n-inliers: 9 pairs", "between 1 and 8"),
}
IN_3D = {
    "bound of full": (("--mode", "full", "--bound", "dc"), "--bound: mode 'full'", "mode"),
    "scale": (("--scale-range", "0.9", "1.1"), "--scale-range: (0.9, 1.1)", "leave it out"),
    "unknown mode": (("--mode", "best"), "--mode: 'best' is unknown", "known: "),
    "misspelled mode": (("--mode", "papr"), "--mode: 'papr'", "did you mean 'paper'"),
}  # fmt: skip
HELP = "Try 'dcreg"
USAGE = {
    "no source and target": (["register"], "Missing argument 'SOURCE'", HELP),
    "no target": (["register", "a2.txt"], "Missing argument 'TARGET'", HELP),
    "no model": (register(model=None), "Missing option '--model'", HELP),
    "number by max_rms": (
        register("--max-rms", "1", n_inliers=None),
        "--n-inliers: --max-rms",
        "give one",
    ),
    "unknown option": (register("--modl", "x"), "No such option: --modl", "--model"),
    "unknown command": (["regster"], "No such command 'regster'", HELP),
    "one argument more": (register("c.txt"), "unexpected extra argument(s) (c.txt)", HELP),
    "option without value": (register("--bound"), "--bound", "requires an argument"),
    "half a scale range": (register("--scale-range", "1"), "--scale-range", "requires 2 arguments"),
    "flag with a value": (register("--quiet=3"), "--quiet", "does not take a value"),
    "verify without files": (["verify"], "Missing argument 'CERT'", HELP),
    "verify without clouds": (["verify", "c.npz"], "Missing argument 'SOURCE'", HELP),
    "version with an argument": (["version", "x"], "unexpected extra argument(s) (x)", HELP),
    "mode of 3D": (register("--mode", "full"), "--mode: 'full' is unknown", "known: "),
    "empty source": (register(source=""), ".: is a folder", "give the path"),
    "key without archive": (register("--source-key", "a"), "key 'a' given", "drop the key"),
}
OUTPUTS = {  # option of register: a name it takes
    "--json": "o.json",
    "--trace": "o.jsonl",
    "--plot": "o.html",
    "--certificate": "o.npz",
    "--output": "o.ply",
}


def _numbers(command: str, call: Call) -> Iterator[Case]:
    for option, values in NUMBERS.items():
        for value, words in values.items():
            yield Case("arguments", f"{command} {option} {value}", call(**{option: value}), words)
    for scale, words in SCALES.items():
        run = call("--scale-range", *scale)
        yield Case("arguments", f"{command} scale range {scale}", run, words)


def _arguments() -> Iterator[Case]:
    yield from _numbers("register", register)
    yield from _numbers("sweep", sweep)
    for text, words in RANGES.items():
        yield Case("arguments", f"sweep n_inliers {text}", sweep(n_inliers=text), words)
    both = register("--tol", "0.1", "--abs-gap", "0.1")
    yield Case("arguments", "two tolerances", both, ["--tol: 0.1", "--abs-gap: 0.1", "give one"])
    for name, (options, *words) in IN_3D.items():
        yield Case("arguments", f"3D {name}", register(*options, dim=3), words)
    for name, (run, *words) in USAGE.items():
        yield Case("arguments", name, run, words)


def _outputs() -> Iterator[Case]:
    calls: list[tuple[Call, dict[str, str]]] = [
        (register, OUTPUTS), (sweep, {"--out": "o.json", "--plot": "o.png"}),
    ]  # fmt: skip
    for call, outputs in calls:
        for option, good in outputs.items():
            name = f"{call.__name__} {option}"
            absent = f"absent/{good}"
            yield Case("outputs", f"{name} without folder", call(option, absent),
                       [f"{option} {absent}", "no folder 'absent'", "create it first"])  # fmt: skip
            yield Case("outputs", f"{name} below a file", call(option, f"a2.txt/{good}"),
                       [f"{option} a2.txt/{good}", "no folder", "create it first"])  # fmt: skip
            yield Case("outputs", f"{name} is a folder", call(option, good),
                       [f"{option} {good}", "not a regular file", "name another file"],
                       {good: None})  # fmt: skip
            source = f"in{good[1:]}"
            yield Case("outputs", f"{name} is an input", call(option, source, "--candidates", source),
                       [f"{option} {source}", "is also an input", "name another file"],
                       {source: b"0 0\n"})  # fmt: skip
            long = 300 * "x" + good
            yield Case("outputs", f"{name} too long", call(option, long),
                       [option, "name", "shorter"])  # fmt: skip
            yield Case("outputs", f"{name} where nothing can be written",
                       call(option, f"/proc/{good}"),
                       [f"{option} /proc/{good}", "cannot write in '/proc'", "elsewhere"])  # fmt: skip
    for option, good in list(OUTPUTS.items())[1:]:
        run = register("--json", good, option, good)
        words = [f"{option} {good}", "is also the file of --json", "name another file"]
        yield Case("outputs", f"{option} as --json", run, words)
    for suffix in (".png", ".pdf", ".svg", ".jpg", ""):
        words = [f"--plot o{suffix}", "must end in .html"]
        yield Case("outputs", f"register --plot {suffix or 'none'}",
                   register("--plot", f"o{suffix}"), words)  # fmt: skip
    for suffix in (".pdf", ".gif", ".tex", ""):
        words = [f"--plot o{suffix}", "must end in .html or .png or .svg"]
        yield Case("outputs", f"sweep --plot {suffix or 'none'}",
                   sweep("--plot", f"o{suffix}"), words)  # fmt: skip
    for suffix in (".xlsx", ".txt", ""):
        words = [f"--out o{suffix}", "must end in .json or .csv"]
        yield Case("outputs", f"sweep --out {suffix or 'none'}",
                   sweep("--out", f"o{suffix}"), words)  # fmt: skip


ARGUMENTS, OUTPUT_CASES = list(_arguments()), list(_outputs())
