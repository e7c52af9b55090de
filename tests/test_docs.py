import re
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[1]
PAGES = sorted((ROOT / "docs").rglob("*.md"))
README = ROOT / "README.md"


def test_the_page_of_the_configuration_is_what_conf_says():
    names: dict[str, object] = {"__name__": "make", "__file__": str(ROOT / "docs" / "make_configuration.py")}
    exec((ROOT / "docs" / "make_configuration.py").read_text(encoding="utf-8"), names)
    page = names["page"]
    assert callable(page)
    shown = (ROOT / "docs" / "configuration.md").read_text(encoding="utf-8")
    assert shown == page(), "run python docs/make_configuration.py"
    for path in (ROOT / "conf").rglob("*.yaml"):
        assert path.stem in shown


@pytest.mark.parametrize("page", [README, ROOT / "CONTRIBUTING.md", *PAGES], ids=lambda path: path.stem)
def test_links_and_files_that_are_named_exist(page):
    text = page.read_text(encoding="utf-8")
    for link in re.findall(r"\]\(([^)#:]+)(?:#[^)]*)?\)", text):
        assert (page.parent / link).exists(), f"{page}: {link}"
    for name in re.findall(r"`((?:foundpose|conf|experiments|tests)/[\w/.]+)`", text):
        assert (ROOT / name.rstrip("/")).exists(), f"{page}: {name}"


@pytest.mark.parametrize("page", ["how-to/extractor.md", "how-to/refiner.md"])
def test_code_of_the_documentation_runs(page):
    for number, code in enumerate(
        re.findall(r"```python\n(.*?)```", (ROOT / "docs" / page).read_text(), re.DOTALL)
    ):
        names: dict[str, object] = {"__name__": "example"}
        exec(compile(code, f"{page}[{number}]", "exec"), names)


def test_examples_of_the_readme_stand_in_the_documentation_too():
    pages = [page.read_text(encoding="utf-8") for page in PAGES]
    for code in re.findall(r"```python\n.*?```", README.read_text(encoding="utf-8"), re.DOTALL):
        assert any(code in page for page in pages)


def test_the_readme_is_short():
    assert len(README.read_text(encoding="utf-8").splitlines()) <= 160
    assert "@@" not in README.read_text(encoding="utf-8")
