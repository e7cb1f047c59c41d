"""TOML with line numbers: tables whose values are taken one by one, so that what is wrong or left over can be pointed at.

Public for this package: `SceneFileError`, `Table`, `read_toml`, `LENGTHS`.
"""

from __future__ import annotations

import difflib
import math
import os
import re
import tomllib
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from ..spectra import Bands

#: Lengths in metres.
LENGTHS = {"km": 1e3, "m": 1.0, "cm": 1e-2, "mm": 1e-3, "um": 1e-6, "in": 0.0254, "ft": 0.3048}
_ANGLES = {"deg": math.pi / 180, "rad": 1.0}
_LARGEST = 1 << 22  # bytes: scene files are written by people
_QUANTITY = re.compile(r"\s*([-+]?(?:\d+\.?\d*|\.\d+)(?:[eE][-+]?\d+)?)\s*(1?/)?\s*([a-z]+)\s*")
_KEY = re.compile(r"""\s*([A-Za-z0-9_-]+|"[^"\\]*"|'[^']*')\s*(\.|=|\]\]?)""")

Path_ = tuple[str | int, ...]


class SceneFileError(ValueError):
    """Something in a scene file cannot be used; the message starts with the file and the line."""


class Table:
    """A table of the file at `path`. Values are taken by name; `done` complains about names nobody took."""

    def __init__(self, values: dict[str, Any], path: Path_, source: Source):
        self.values, self.path, self.source = values, path, source
        self.known: list[str] = []

    def fail(self, key: str | None, got: object, expected: str, advice: str) -> SceneFileError:
        """The error to raise about a key, or about the table as a whole."""
        path = self.path if key is None else (*self.path, key)
        shown = got if isinstance(got, str) else repr(got)
        shown = shown if len(shown) <= 80 else shown[:77] + "..."
        return SceneFileError(f"{self.source.at(path)}: {_name(path)}: got {shown}, expected {expected}; {advice}")

    def take(self, key: str, default: Any = ..., read: Callable[[Table, str, Any], Any] | None = None) -> Any:
        """The value of a key, as `read(table, key, value)` makes it; without a default it must be there."""
        self.known.append(key)
        if key not in self.values:
            if default is ...:
                raise self.fail(None, f"no {key}", f"a value for {key}", f"add a line {key} = ...")
            return default
        value = self.values[key]
        return value if read is None else read(self, key, value)

    def has(self, key: str) -> bool:
        return key in self.values

    def table(self, key: str) -> Table:
        """The table of a key, empty if it is not there."""
        self.known.append(key)
        value = self.values.get(key, {})
        if not isinstance(value, dict):
            raise self.fail(key, value, "a table", f"write [{key}] and its values below")
        return Table(value, (*self.path, key), self.source)

    def tables(self, key: str) -> list[Table]:
        """The tables of a key, none if it is not there."""
        self.known.append(key)
        value = self.values.get(key, [])
        if not (isinstance(value, list) and all(isinstance(item, dict) for item in value)):
            raise self.fail(key, value, "a list of tables", f"write [[{key}]] above each")
        return [Table(item, (*self.path, key, i), self.source) for i, item in enumerate(value)]

    def done(self) -> None:
        """Raise for a key that is no part of this table."""
        for key in self.values:
            if key not in self.known:
                near = difflib.get_close_matches(key, self.known, n=1, cutoff=0.6)
                advice = f"did you mean {near[0]}?" if near else "leave it out"
                raise self.fail(key, "a name that means nothing here", f"one of {', '.join(dict.fromkeys(self.known))}", advice)

    @contextmanager
    def checked(self, **keys: str) -> Iterator[None]:
        """Errors of the library, with this table's line, or its key's where the message names one.

        `keys`: what the file calls the arguments that errors name, where it calls them otherwise.
        """
        try:
            yield
        except SceneFileError:
            raise
        except (ValueError, TypeError, OSError, ImportError) as error:
            text = str(error)
            named = re.match(r"[A-Za-z_]+", text)
            if named and named.group() in keys:
                text = keys[named.group()] + text[named.end() :]
                named = re.match(r"[A-Za-z_]+", text)
            key = named.group() if named and named.group() in self.values else None
            where = self.source.at(self.path if key is None else (*self.path, key))
            raise SceneFileError(f"{where}: {_name(self.path)}{': ' if self.path else ''}{text}") from error

    # What values may be

    def number(self, key: str, value: Any) -> float:
        if isinstance(value, bool) or not isinstance(value, int | float) or not math.isfinite(value):
            raise self.fail(key, value, "a finite number", f"write {key} = 1.0")
        return float(value)

    def whole(self, key: str, value: Any) -> int:
        if isinstance(value, bool) or not isinstance(value, int):
            raise self.fail(key, value, "a whole number", f"write {key} = 1")
        return value

    def text(self, key: str, value: Any) -> str:
        if not isinstance(value, str):
            raise self.fail(key, value, "text", f'write {key} = "..."')
        return value

    def flag(self, key: str, value: Any) -> bool:
        if not isinstance(value, bool):
            raise self.fail(key, value, "true or false", f"write {key} = true")
        return value

    def numbers(self, key: str, value: Any) -> Any:
        """A number, a list of them, or a spectrum."""
        if isinstance(value, dict):
            return self.spectrum(key, value)
        return [self.number(key, v) for v in value] if isinstance(value, list) and value else self.number(key, value)

    def spectrum(self, key: str, value: dict[str, Any]) -> list[float]:
        """A number for each of the file's bands of wavelength: of a known spectrum, or of a measured one."""
        bands = self.source.bands
        if bands is None:
            advice = "write [bands] and below edges = [400, 500, 600, 700], in nm"
            raise self.fail(key, "a spectrum", "wavelengths for its bands", advice)
        table = Table(value, (*self.path, key), self.source)
        kinds = [name for name in ("reflectance", "illuminant", "temperature", "wavelengths") if table.has(name)]
        scale = table.take("scale", 1.0, Table.number)
        if len(kinds) != 1:
            expected = "one of reflectance, illuminant, temperature, or wavelengths with values"
            raise table.fail(None, " and ".join(kinds) or "none of them", expected, 'write { illuminant = "D65", scale = 2.0 }')
        with table.checked():
            if kinds[0] == "wavelengths":
                found = bands.mean(table.take("wavelengths", read=Table._list), table.take("values", read=Table._list))
            elif kinds[0] == "temperature":
                found = bands.blackbody(table.take("temperature", read=Table.number))
            else:
                found = getattr(bands, kinds[0])(table.take(kinds[0], read=Table.text))
        table.known += ["reflectance", "illuminant", "temperature", "wavelengths", "values"]
        table.done()
        return [float(scale * v) for v in found]

    def _list(self, key: str, value: Any) -> list[float]:
        if not (isinstance(value, list) and value):
            raise self.fail(key, value, "a list of numbers", f"write {key} = [400, 700]")
        return [self.number(key, v) for v in value]

    def vector(self, key: str, value: Any) -> list[float]:
        return self._triple(key, value, self.number)

    def length(self, key: str, value: Any) -> float:
        return self._quantity(key, value, LENGTHS, '"25 cm"') / (1.0 if not isinstance(value, str) else self.source.unit)

    def place(self, key: str, value: Any) -> list[float]:
        """Three lengths."""
        return self._triple(key, value, self.length)

    def places(self, key: str, value: Any) -> list[float]:
        """A list of lengths."""
        if not isinstance(value, list):
            raise self.fail(key, value, "a list of lengths", f"write {key} = [0.0, 0.0]")
        return [self.length(key, v) for v in value]

    def angle(self, key: str, value: Any) -> float:
        """In radians; a bare number is in degrees."""
        if isinstance(value, str):
            return self._quantity(key, value, _ANGLES, '"30 deg"')
        return math.radians(self.number(key, value))

    def per_length(self, key: str, value: Any) -> Any:
        """A number or a list of them, per length; or a spectrum."""
        if isinstance(value, dict):
            return self.spectrum(key, value)
        if isinstance(value, list) and value:
            return [self._per_length(key, v) for v in value]
        return self._per_length(key, value)

    def _per_length(self, key: str, value: Any) -> float:
        inverse = {name: 1 / size for name, size in LENGTHS.items()}
        return self._quantity(key, value, inverse, '"0.3 /m"', per=True) * (
            1.0 if not isinstance(value, str) else self.source.unit
        )

    def _triple(self, key: str, value: Any, read: Callable[[str, Any], float]) -> list[float]:
        if not isinstance(value, list) or len(value) != 3:
            raise self.fail(key, value, "three numbers", f"write {key} = [x, y, z]")
        return [read(key, v) for v in value]

    def _quantity(self, key: str, value: Any, units: dict[str, float], example: str, per: bool = False) -> float:
        if not isinstance(value, str):
            return self.number(key, value)
        found = _QUANTITY.fullmatch(value)
        if not found or found.group(3) not in units or bool(found.group(2)) != per:
            names = ", ".join(f"/{name}" if per else name for name in units)
            raise self.fail(key, value, f"a number and one of {names}", f"write {example}, or a bare number")
        return self.number(key, float(found.group(1))) * units[found.group(3)]


class Source:
    """A file: its name, the lines of its keys, its unit of length in metres, and its bands of wavelength, if it has any."""

    def __init__(self, name: str, folder: Path, lines: dict[Path_, int]):
        self.name, self.folder, self.lines = name, folder, lines
        self.unit = 1.0
        self.bands: Bands | None = None

    def at(self, path: Path_) -> str:
        while path and path not in self.lines:
            path = path[:-1]
        return f"{self.name}:{self.lines.get(path, 1)}"


def read_toml(path: str | os.PathLike[str]) -> Table:
    """The file as a table. **Raises** `FileNotFoundError`, or `SceneFileError` with the line that is no TOML."""
    path = Path(path)
    if not path.is_file():
        raise FileNotFoundError(f"path: got {str(path)!r}, expected a file that exists; write one with `raymanifold init`")
    if path.stat().st_size > _LARGEST:
        raise SceneFileError(
            f"{path}: got {path.stat().st_size} bytes, expected a scene file; keep arrays in files of their own"
        )
    try:
        text = path.read_bytes().decode("utf-8").replace("\r\n", "\n")
        values = tomllib.loads(text)
    except UnicodeDecodeError as error:
        line = path.read_bytes()[: error.start].count(b"\n") + 1
        raise SceneFileError(f"{path}:{line}: got bytes that are no UTF-8, expected text; save it as UTF-8") from error
    except tomllib.TOMLDecodeError as error:
        found = re.search(r"line (\d+)", str(error))
        line = found.group(1) if found else str(text.count("\n") + 1)
        raise SceneFileError(f"{path}:{line}: got no TOML ({error}), expected key = value; see toml.io") from error
    except RecursionError as error:
        raise SceneFileError(f"{path}:1: got lists nested too deeply, expected a scene file; flatten them") from error
    return Table(values, (), Source(str(path), path.parent, _lines(text)))


def _name(path: Path_) -> str:
    text = "".join(f"[{part}]" if isinstance(part, int) else f".{part}" for part in path)
    return text.removeprefix(".") or "scene"


def _lines(text: str) -> dict[Path_, int]:
    """The line of every table and of every key that starts a line. `text` is known to be TOML."""
    lines: dict[Path_, int] = {}
    counts: dict[Path_, int] = {}
    table: Path_ = ()
    for number, line in _logical(text):
        stripped = line.lstrip()
        if stripped.startswith("["):
            many = stripped.startswith("[[")
            table = ()
            names = _keys(stripped[2 if many else 1 :])
            for i, name in enumerate(names):
                table = (*table, name)
                if many and i == len(names) - 1:
                    counts[table] = counts.get(table, -1) + 1
                    lines.setdefault(table, number)
                if table in counts:
                    table = (*table, counts[table])
            lines.setdefault(table, number)
        elif names := _keys(stripped):
            for i in range(len(names)):
                lines.setdefault((*table, *names[: i + 1]), number)
    return lines


def _keys(text: str) -> list[str]:
    names, at = [], 0
    while found := _KEY.match(text, at):
        names.append(found.group(1).strip("\"'"))
        at = found.end()
        if found.group(2) != ".":
            break
    return names


def _logical(text: str) -> Iterator[tuple[int, str]]:
    """Lines that start a table or a key: not those inside strings or brackets that go on."""
    depth, quote, at_start, start, begin = 0, "", True, 1, 0
    number, i = 1, 0
    while i < len(text):
        c = text[i]
        if at_start and c not in " \t\n":
            start, begin, at_start = number, i, False
        if quote:
            if c == "\\" and quote[0] == '"':
                number += text[i + 1 : i + 2] == "\n"
                i += 1
            elif text.startswith(quote, i):
                i += len(quote) - 1
                quote = ""
        elif c in "\"'":
            quote = c * 3 if text.startswith(c * 3, i) else c
            i += len(quote) - 1
        elif c == "#":
            end = text.find("\n", i)
            i = (len(text) if end < 0 else end) - 1
        elif c in "[{":
            depth += 1
        elif c in "]}":
            depth -= 1
        if i < len(text) and text[i] == "\n":
            number += 1
            if not quote and depth <= 0:
                if not at_start:
                    yield start, text[begin:i]
                at_start, depth = True, 0
        i += 1
    if not at_start:
        yield start, text[begin:]
