"""The README's code runs as written."""

import re
from pathlib import Path

import pytest

README = Path(__file__).parents[1] / "README.md"


def _blocks():
    return re.findall(r"```python\n(.*?)```", README.read_text(), re.S)


def test_there_is_code():
    assert _blocks()


@pytest.mark.parametrize("index", range(len(_blocks())))
def test_code_runs(index, capsys):
    scope = {}
    exec(compile(_blocks()[index], f"README.md block {index}", "exec"), scope)
    # What the last comment of the block says is printed.
    said = re.findall(r"# (\([\d, ]+\))$", _blocks()[index], re.M)
    assert said and said[-1] in capsys.readouterr().out


def test_pictures_exist():
    for name in re.findall(r"\]\((docs/[^)]+)\)", README.read_text()):
        assert (README.parent / name).is_file(), f"README.md shows {name}, which is missing"
