"""The command ``foundpose``: the apps of ``experiments/``, from a checkout or from an installed wheel."""

import ast
import importlib.metadata
import os
import runpy
import sys
from pathlib import Path

from foundpose.config import apps_folder

HIDDEN = {"finding", "scenes"}  # modules beside the apps
EXTRAS = {  # what an installation may lack, and the extra that brings it
    **dict.fromkeys(("pytorch_lightning", "pandas", "plotly", "matplotlib"), "evaluate"),
    **dict.fromkeys(("cv2", "faiss", "sklearn"), "benchmark"),
}


def main() -> None:
    """Run ``foundpose COMMAND [OVERRIDES…]``, which is ``python experiments/COMMAND.py [OVERRIDES…]``."""
    arguments = sys.argv[1:]
    scripts = apps()
    if not arguments or arguments[0] in ("-h", "--help"):
        print(usage(scripts))
    elif arguments[0] == "--version":
        print(importlib.metadata.version("foundpose"))
    elif arguments[0] == "info":
        print(info())
    elif arguments[0] in scripts:
        script = scripts[arguments[0]]
        sys.argv = [str(script), *arguments[1:]]
        sys.path.insert(0, str(script.parent))
        try:
            runpy.run_path(str(script), run_name="__main__")
        except ModuleNotFoundError as error:
            if error.name not in EXTRAS:
                raise
            print(f"error: {error}: pip install 'foundpose[{EXTRAS[error.name]}]'", file=sys.stderr)
            sys.exit(2)
    else:
        print(
            f"error: no command {arguments[0]!r}; there are {', '.join([*scripts, 'info'])}", file=sys.stderr
        )
        sys.exit(2)


def apps() -> dict[str, Path]:
    """The scripts by the names of their commands."""
    scripts = sorted((apps_folder() / "experiments").glob("*.py"))
    return {script.stem: script for script in scripts if script.stem not in HIDDEN}


def usage(scripts: dict[str, Path]) -> str:
    """What ``foundpose --help`` prints: a line and an example of each command, from the scripts themselves."""
    lines = ["foundpose COMMAND [key=value …]; foundpose COMMAND --help shows the keys", ""]
    for name, script in scripts.items():
        paragraphs = (ast.get_docstring(ast.parse(script.read_text(encoding="utf-8"))) or "").split("\n\n")
        example = paragraphs[-1].splitlines()[0].replace(f"python experiments/{name}.py", f"foundpose {name}")
        lines += [f"  {name:15} {' '.join(paragraphs[0].split())}", f"  {'':15}   {example}"]
    lines += [f"  {'info':15} Versions, devices, folders and weights that are found."]
    return "\n".join(lines)


def info() -> str:
    """Versions, devices, folders and weights that are found."""
    import torch

    from foundpose.features.wheel import cache_folder

    packages = (
        "foundpose",
        "torch",
        "kornia",
        "transformers",
        "trimesh",
        "pyrender",
        "pytorch-lightning",
        "matplotlib",
    )
    facts = {}
    for name in packages:
        try:
            facts[name] = importlib.metadata.version(name)
        except importlib.metadata.PackageNotFoundError:
            facts[name] = "not installed"
    facts["python"] = sys.version.split()[0]
    gpus = [torch.cuda.get_device_name(i) for i in range(torch.cuda.device_count())]
    facts["GPUs"] = ", ".join(gpus) or "none that PyTorch sees"
    facts["processors"] = f"{os.cpu_count()}, of which PyTorch uses {torch.get_num_threads()}"
    facts["apps and conf"] = str(apps_folder())
    cache = cache_folder()
    facts["converted weights"] = f"{cache}: " + (", ".join(sorted(p.name for p in cache.glob("*"))) or "none")
    return "\n".join(f"{name:20} {value}" for name, value in facts.items())


if __name__ == "__main__":
    main()
