"""Writes docs/configuration.md from conf/: every app, group, option and key. Run it after a change of conf/."""

from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]
INTRODUCTION = """# Configuration

Written from `conf/` by `python docs/make_configuration.py`.

`python experiments/APP.py GROUP=OPTION KEY=VALUE …` composes a run: an app's file on top of `config.yaml`, with
an option of each group. Keys of nodes with `_target_` are the parameters of that class, whose docstring
explains them. `python experiments/APP.py --cfg job` prints what a command line comes to, and
`foundpose.load(overrides=["GROUP=OPTION"])` builds it in Python. For example, another layer, fewer templates
and hard assignment:

```
python experiments/estimate.py data=lmo extractor.layer=12 viewpoints.count=400 words.num_words=1024 bow=hard_assign
```
"""


def page() -> str:
    """The page's text."""
    conf = ROOT / "conf"
    parts = [INTRODUCTION, "## The default configuration\n", block(conf / "config.yaml"), "## Apps\n"]
    for path in sorted(conf.glob("*.yaml")):
        if path.stem != "config":
            parts += [f"### {path.stem}\n", block(path)]
    parts.append("## Groups\n")
    for folder in sorted(path for path in conf.iterdir() if path.is_dir()):
        options = sorted(folder.glob("*.yaml"))
        names = ", ".join(f"`{option.stem}`" for option in options)
        parts.append(f"### {folder.name}\n\n{names}\n")
        parts += [f"`{folder.name}={option.stem}`\n\n{block(option)}" for option in options]
    return "\n".join(parts)


def block(path: Path) -> str:
    """A file as a block of code."""
    return f"```yaml\n{path.read_text(encoding='utf-8').strip()}\n```\n"


if __name__ == "__main__":
    (ROOT / "docs" / "configuration.md").write_text(page(), encoding="utf-8")
