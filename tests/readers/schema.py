"""Validates scenario files against a JSON Schema with an independent validator.

    schema.py SCHEMA FILE...

Prints a line per file: its name, and `valid`, or `invalid` with place and message of the most deeply nested error.
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
        deepest = max(errors, key=lambda error: len(error.absolute_path))
        place = ".".join(str(step) for step in deepest.absolute_path)
        print(f"{name}: invalid: {place}: {deepest.message}".replace("\n", " "))
    else:
        print(f"{name}: valid")
