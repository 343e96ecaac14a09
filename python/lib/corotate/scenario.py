"""What a scenario may be given as. Must not know what is in one."""

import json
import operator
import os


def given(scenario):
    """A scenario as programs take it: a text, and its kind: the path of a file, the name of a shipped one, or TOML."""
    if isinstance(scenario, dict):
        return "".join(f"{json.dumps(str(key))} = {toml(value)}\n" for key, value in scenario.items()), "text"
    path = os.fspath(scenario)
    is_path = not isinstance(scenario, str) or "/" in path or path.endswith(".toml")
    return path, "path" if is_path else "name"


def toml(value):
    """A value as TOML on one line."""
    if isinstance(value, dict):
        return "{" + ", ".join(f"{json.dumps(str(key))} = {toml(item)}" for key, item in value.items()) + "}"
    if isinstance(value, (list, tuple)) or hasattr(value, "tolist"):
        values = value.tolist() if hasattr(value, "tolist") else value
        return "[" + ", ".join(map(toml, values)) + "]" if isinstance(values, (list, tuple)) else toml(values)
    if isinstance(value, float):
        # TOML has infinities and NaN too, spelled as by repr and not as in JSON.
        return repr(value)
    if isinstance(value, os.PathLike):
        value = os.fspath(value)
    return json.dumps(value)


def overrides(changes):
    """Changes by key as `KEY=VALUE`."""
    changes = {**changes, "seed": seed_of(changes["seed"])} if "seed" in changes else changes
    return [f"{key}={toml(value)}" for key, value in changes.items()]


def seed_of(value):
    """A seed as an int: any integer, also numpy's, from 0 to 2**63 - 1, which is what a scenario file can hold."""
    try:
        seed = operator.index(value)
    except TypeError:
        seed = -1
    if not 0 <= seed < 2**63:
        raise ValueError(f"seed = {value!r}: a seed is an integer from 0 to 2**63 - 1")
    return seed
