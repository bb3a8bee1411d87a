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


PAGES = [README, *sorted((README.parent / "docs").glob("*.md"))]


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.name)
def test_pictures_and_pages_exist(page):
    links = re.findall(r"\]\((?!http)([^)#]+)\)", page.read_text())
    assert links
    for name in links:
        assert (page.parent / name).is_file(), f"{page.name} shows {name}, which is missing"


def test_every_picture_is_shown_and_every_command_named():
    shown = "".join(page.read_text() for page in PAGES)
    pictures = [p for p in (README.parent / "docs").iterdir() if p.suffix in (".png", ".gif")]
    for picture in pictures:
        assert f"{picture.name})" in shown, f"docs/{picture.name} is shown nowhere"
    for path in (README.parent / "experiments").glob("*.py"):
        if 'if __name__ == "__main__"' in path.read_text():
            named = rf"`(python -m experiments\.)?{path.stem}`"
            assert re.search(named, README.read_text()), f"README.md does not name {path.stem}"
