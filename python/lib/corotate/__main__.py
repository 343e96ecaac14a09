"""`python -m corotate`: the command line, and the roles that a run starts."""

import sys

from . import _corotate


def main():
    """Does what the command line asks for."""
    sys.exit(_corotate.main(["corotate", *sys.argv[1:]]))


if __name__ == "__main__":
    main()
