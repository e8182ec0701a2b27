"""A mapping as the text of a TOML file."""

import datetime
import json
import math
import re

BARE = re.compile(r"[A-Za-z0-9_-]+\Z")


def text(value):
    """A basic string. JSON differs only in what is above U+007E, which stays as it is here, and in DEL."""
    return json.dumps(str(value), ensure_ascii=False).replace("\x7f", "\\u007F")


def key(name):
    return str(name) if BARE.match(str(name)) else text(name)


def number(value):
    if math.isnan(value):
        return "nan"
    if math.isinf(value):
        return "inf" if value > 0 else "-inf"
    return repr(value)


def inline(value, path):
    """The value on one line."""
    if isinstance(value, bool):
        return "true" if value else "false"
    if isinstance(value, int):
        return str(int(value))
    if isinstance(value, float):
        return number(value)
    if isinstance(value, str):
        return text(value)
    if isinstance(value, (datetime.datetime, datetime.date)):
        return value.isoformat()
    if isinstance(value, dict):
        items = (f"{key(name)} = {inline(item, f'{path}.{name}')}" for name, item in value.items())
        return "{ " + ", ".join(items) + " }" if value else "{}"
    if isinstance(value, (list, tuple)):
        return "[" + ", ".join(inline(item, f"{path}[{n}]") for n, item in enumerate(value)) + "]"
    raise ValueError(f"TOML has no {type(value).__name__}; at {path}; leave the key out, or give it a value")


def is_tables(value):
    return isinstance(value, list) and bool(value) and all(isinstance(item, dict) for item in value)


def table(mapping, path, lines):
    own = {name: value for name, value in mapping.items() if not isinstance(value, dict) and not is_tables(value)}
    lines.extend(f"{key(name)} = {inline(value, '.'.join([*path, str(name)]))}" for name, value in own.items())
    for name, value in mapping.items():
        if name in own:
            continue
        below = [*path, key(name)]
        for item in [value] if isinstance(value, dict) else value:
            heading = ".".join(below)
            lines.extend(["", f"[{heading}]" if isinstance(value, dict) else f"[[{heading}]]"])
            table(item, below, lines)


def to_toml(mapping):
    if not isinstance(mapping, dict):
        raise ValueError("a TOML file is a mapping; write keys and values")
    lines = []
    table(mapping, [], lines)
    return "\n".join(lines).lstrip("\n") + "\n"
