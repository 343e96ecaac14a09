"""Holds scenario files against a JSON Schema with a validator that shares no code with ours.

    schema.py SCHEMA FILE...

A line per file: its name and `valid`, or `invalid` with where the first mistake is and what the validator says of it.
"""

import json
import sys
import tomllib
from pathlib import Path

from jsonschema import Draft7Validator

schema = json.loads(Path(sys.argv[1]).read_text(encoding="utf-8"))
Draft7Validator.check_schema(schema)
validator = Draft7Validator(schema)
for name in sys.argv[2:]:
    scenario = tomllib.loads(Path(name).read_text(encoding="utf-8"))
    errors = list(validator.iter_errors(scenario))
    if errors:
        first = max(errors, key=lambda error: len(error.absolute_path))
        place = ".".join(str(step) for step in first.absolute_path)
        print(f"{name}: invalid: {place}: {first.message}".replace("\n", " "))
    else:
        print(f"{name}: valid")
