"""Changes of valid files: of bytes, words, lines, trees of YAML or JSON, arrays and tables."""

from __future__ import annotations

import copy
import warnings
from collections.abc import Callable
from random import Random
from typing import Any

import numpy as np
import pandas as pd

NUMBERS = (
    0, 1, -1, 2, 3, 255, -(2**31), 2**31 - 1, 2**31, 2**32, 2**63 - 1, 2**63, 10**30, 0.5, -0.0, 1e-320,
    1e308, -1e308, float("nan"), float("inf"), -float("inf"),
)  # fmt: skip
TEXTS = (
    "", " ", "x", "nan", "-1", "1e999", "²", "٣", "é\u202e", "a\nb", "a" * 300, "..", "../../x",
    "/dev/null", "a\0b", "_", "[31m", "null", "{}", "%s", "${HOME}",
)  # fmt: skip
VALUES = (None, True, False, *NUMBERS, *TEXTS, [], {}, [[]], [None], {"x": 1}, [1, 2, 3], {"": {}})
# What replaces a word of a text file or stands before it.
WORDS = (
    *map(str, NUMBERS), *TEXTS, "9" * 5000, "-" + "9" * 400, "1_000", "0x10", "1,5", "1;5", "#", "//",
    '"', '"a', "'", ",", ";", "1e", "+", "--", "0" * 200_000, "\ufeff", "\t", "x y z", "vertex",
)  # fmt: skip
YAML_WORDS = (
    "&a", "*a", "&a [*a]", "&a {x: *a}", "<<: *a", "<<: [*a, *a]",
    "!!python/object/apply:os.getcwd []", "!!binary x", "!!set {x}", "!!omap [x: 1]", "!!pairs [x: 1]",
    "!!timestamp x", "!!int x", "!!float x", "!!str", "!!null x", "!local", "!", "? ", "? [a]: b", "-",
    "- - -", ":", "a: b: c", "|", ">-", "%YAML 9.9", "---", "...", "[" * 2000, "{a: " * 500, "]", "}",
    "1:30:00", "2001-13-45", "2001-01-01", "0b2", "0o9", ".inf", "-.INF", ".nan", "=", "~", "\"\\x",
    "\"\\ud800\"", "yes", "@", "`", "\x85", "\u2028", "\x07",
    "[&a [x, x, x, x, x, x, x, x], &b [*a, *a, *a, *a, *a, *a], &c [*b, *b, *b, *b, *b, *b], *c]",
)  # fmt: skip
DTYPES = (
    "f2", "f4", ">f8", "f16", "c16", "i1", ">i4", "u8", "?", "S5", "U5", "M8[s]", "m8[us]", "V8", "O",
    "f8,i4",
)  # fmt: skip


def in_bytes(rng: Random, content: bytes) -> bytes:
    """Change, remove, repeat or insert a few bytes."""
    data = bytearray(content)
    for _ in range(rng.choice((1, 1, 1, 2, 3, 8))):
        at = rng.randrange(len(data) + 1)
        size = rng.choice((1, 1, 2, 4, 8, 64, 1000))
        match rng.randrange(7):
            case 0:
                data[at : at + 1] = bytes([rng.randrange(256)])
            case 1:
                data[at : at + 1] = (
                    bytes([data[at] ^ (1 << rng.randrange(8))]) if at < len(data) else b""
                )
            case 2:
                del data[at : at + size]
            case 3:
                data[at:at] = data[rng.randrange(len(data) + 1) :][:size]
            case 4:
                data[at:at] = rng.randbytes(size)
            case 5:
                number = rng.choice((0, 1, 2**15, 2**16 - 1, 2**31 - 1, 2**31, 2**32 - 1))
                data[at : at + 4] = number.to_bytes(4, rng.choice(("little", "big")))
            case 6:
                del data[at:]
    return bytes(data)


def in_words(rng: Random, content: bytes, words: tuple[str, ...] = WORDS) -> bytes:
    """Change, remove, repeat, exchange or insert words and lines of a text; bytes after it stay."""
    text = content.decode("latin-1")
    for _ in range(rng.choice((1, 1, 2, 4))):
        lines = text.split("\n")
        row = rng.randrange(len(lines))
        parts = lines[row].split(" ")
        at = rng.randrange(len(parts))
        word = rng.choice(words).encode("utf-8", "surrogatepass").decode("latin-1")
        match rng.randrange(9):
            case 0 | 1:
                parts[at] = word
            case 2:
                parts.insert(at, word)
            case 3:
                del parts[at]
            case 4:
                parts[at] = f"{word}{parts[at]}"
            case 5:
                del lines[row]
            case 6:
                lines.insert(rng.randrange(len(lines) + 1), lines[row])
            case 7:
                other = rng.randrange(len(lines))
                lines[row], lines[other] = lines[other], lines[row]
                row = other
            case 8:
                lines.insert(row, word)
        if row < len(lines) and len(parts) and lines[row].split(" ") != parts:
            lines[row] = " ".join(parts)
        text = rng.choice(("\n", "\n", "\n", "\r\n")).join(lines)
    return text.encode("latin-1")


def in_tree(rng: Random, tree: Any) -> Any:
    """Change, remove, add, exchange or nest values and keys of a YAML or JSON document."""
    tree = copy.deepcopy(tree)
    for _ in range(rng.choice((1, 1, 1, 2, 3))):
        places = list(_places(tree))
        if not places:
            return rng.choice(VALUES)
        owner, key = rng.choice(places)
        other, other_key = rng.choice(places)
        match rng.randrange(8):
            case 0 | 1:
                owner[key] = copy.deepcopy(rng.choice(VALUES))
            case 2:
                del owner[key]
            case 3:
                owner[key] = copy.deepcopy(other[other_key])
            case 4:
                owner[key], other[other_key] = other[other_key], owner[key]
                if owner[key] is owner or other[other_key] is other or _is_cyclic(tree):
                    return rng.choice(VALUES)
            case 5:
                owner[key] = rng.choice(([owner[key]], {"x": owner[key]}, [owner[key]] * 3))
            case 6:
                _rename(rng, owner, key, other_key)
            case 7:
                if isinstance(owner, list):
                    owner.insert(key, copy.deepcopy(rng.choice(VALUES)))
                else:
                    owner[rng.choice(TEXTS)] = copy.deepcopy(rng.choice(VALUES))
    return tree


def _rename(rng: Random, owner: Any, key: Any, other_key: Any) -> None:
    if isinstance(owner, dict):
        owner[rng.choice((other_key, *TEXTS, 1, None, 2.5, True))] = owner.pop(key)


def _places(tree: Any) -> list[tuple[Any, Any]]:
    """Return every container of a tree with each of its keys or indices."""
    keys = tree if isinstance(tree, dict) else range(len(tree)) if isinstance(tree, list) else ()
    return [place for key in keys for place in ((tree, key), *_places(tree[key]))]


def _is_cyclic(tree: Any, above: tuple[int, ...] = ()) -> bool:
    if not isinstance(tree, dict | list):
        return False
    inner = tree.values() if isinstance(tree, dict) else tree
    return id(tree) in above or any(_is_cyclic(each, (*above, id(tree))) for each in inner)


def in_array(rng: Random, array: np.ndarray) -> np.ndarray:
    """Change values, shape or type of an array."""
    match rng.randrange(8):
        case 0 | 1 | 2 if array.dtype.kind in "fiu" and array.size:
            changed = array.astype(rng.choice((array.dtype, np.float64)))
            with np.errstate(all="ignore"):
                number = np.array(rng.choice(NUMBERS), dtype=float).astype(changed.dtype)
            changed.flat[rng.randrange(array.size)] = number
            return changed
        case 3:
            return np.atleast_1d(array)[
                rng.choice((slice(0), slice(1, None), slice(-1), ..., None))
            ]
        case 4:
            return rng.choice((array.T, array.reshape(-1), np.stack([array, array]), np.array(7)))
        case 5:
            return np.repeat(array, 2, axis=rng.randrange(array.ndim)) if array.ndim else array
        case _:
            return _as_type(array, rng.choice(DTYPES))


def _as_type(array: np.ndarray, dtype: str) -> np.ndarray:
    with np.errstate(all="ignore"), warnings.catch_warnings():
        warnings.simplefilter("ignore")  # that the imaginary part is lost
        try:
            return array.astype(dtype)
        except (ValueError, TypeError, OverflowError, RuntimeError):
            return np.zeros(array.shape, dtype)


def in_arrays(rng: Random, arrays: dict[str, np.ndarray]) -> dict[str, np.ndarray]:
    """Change, remove, rename, exchange or add arrays."""
    found = dict(arrays)
    for _ in range(rng.choice((1, 1, 2))):
        name, other = rng.choice(sorted(found) or [""]), rng.choice(sorted(found) or [""])
        match rng.randrange(8):
            case 0:
                found.pop(name, None)
            case 1:
                found[rng.choice(("x", "a b", "../x", "é", "format", other))] = found.get(
                    name, np.eye(2)
                )
            case 2 if found:
                found[name], found[other] = found[other], found[name]
            case _ if found:
                found[name] = in_array(rng, found[name])
    return found


def in_table(rng: Random, table: pd.DataFrame) -> pd.DataFrame:
    """Change values, columns or rows of a table."""
    name, other = rng.choice(list(table)), rng.choice(list(table))
    match rng.randrange(8):
        case 0:
            return table.drop(columns=name)
        case 1:
            return table.rename(columns={name: rng.choice(("x", "", f"{other}_"))})
        case 2:
            return table.iloc[: rng.choice((0, 1, len(table) // 2))]
        case 3:
            return pd.concat([table, table.iloc[:2]], ignore_index=True)
        case 4:
            return table.assign(**{name: table[other].to_numpy()})
        case 5:
            return table.assign(**{name: table[name].astype(str)})
        case _:
            return table.assign(**{name: rng.choice((None, *NUMBERS[:12], *NUMBERS[13:], *TEXTS))})


Change = Callable[[Random, Any], Any]
