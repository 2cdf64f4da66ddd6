"""``python -m tests.fuzz.guided TARGET [libFuzzer options and folders]``: one target under atheris."""

import sys

import atheris

with atheris.instrument_imports(include=["zbridge", "gateways"]):
    from tests.fuzz.registry import TARGETS


def main() -> None:
    target = TARGETS[sys.argv[1]]
    atheris.Setup([sys.argv[0], *sys.argv[2:]], target.run)
    atheris.Fuzz()


if __name__ == "__main__":
    main()
