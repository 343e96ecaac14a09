"""Reads every Parquet file of a directory with an independent library, and writes the values.

    parquet.py DIRECTORY

Writes beside NAME.parquet: NAME.words, every value as 8 little-endian bytes, column after column; NAME.json, names and
types of the columns, rows per group, metadata. The test compares the words bit for bit with the recording.
"""

import json
import sys
from pathlib import Path

import pyarrow.parquet


def main():
    for path in Path(sys.argv[1]).glob("*.parquet"):
        file = pyarrow.parquet.ParquetFile(path)
        table = file.read()
        assert not any(field.nullable for field in table.schema), table.schema
        words = [column.to_numpy() for column in table.columns]
        assert all(column.dtype.str in ("<u8", "<f8") for column in words), table.schema
        path.with_suffix(".words").write_bytes(b"".join(column.tobytes() for column in words))
        about = {
            "columns": [[field.name, str(field.type)] for field in table.schema],
            "groups": [file.metadata.row_group(index).num_rows for index in range(file.num_row_groups)],
            "metadata": {key.decode(): value.decode() for key, value in file.metadata.metadata.items()},
        }
        path.with_suffix(".json").write_text(json.dumps(about))


if __name__ == "__main__":
    main()
