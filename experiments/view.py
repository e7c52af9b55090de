"""Look at an onboarded object: its templates in a grid with their visual words, nearest views, and a turntable.

python experiments/view.py cup.safetensors
python experiments/view.py cup.safetensors mesh=cup.ply
"""

import sys
from pathlib import Path

import hydra
from hydra.core.hydra_config import HydraConfig
from omegaconf import DictConfig
from PIL import Image

from foundpose.config import clear_errors
from foundpose.rendering import load_mesh
from foundpose.representation import ObjectRepresentation
from foundpose.utils.files import write_atomically
from foundpose.utils.progress import say
from foundpose.visualization.templates import TemplateViewer, spread_templates


@hydra.main(version_base="1.3", config_path="../conf", config_name="view")
def main(cfg: DictConfig) -> None:
    """Write templates.png, neighbours.png and turntable.webp to the run's folder."""
    with clear_errors():
        view(cfg, Path(HydraConfig.get().runtime.output_dir))


def view(cfg: DictConfig, output: Path) -> None:
    """Draw what is to be seen, and print what the representation holds."""
    if cfg.representation is None:
        raise ValueError("give the file of a representation: foundpose view cup.safetensors")
    representation = ObjectRepresentation.load(cfg.representation)
    mesh = None if cfg.mesh is None else load_mesh(cfg.mesh, cfg.color)
    if mesh is not None and mesh.checksum != representation.info.mesh_checksum:
        say(f"warning: {cfg.representation} was not made of {cfg.mesh}")
    viewer = TemplateViewer(representation, mesh)
    shown = spread_templates(representation, cfg.templates)
    write_atomically(output / "templates.png", viewer.grid(shown).save)
    rows = [viewer.neighbours(index) for index in shown[: cfg.neighbours]]
    for number, row in enumerate(rows):
        write_atomically(output / f"neighbours_{number}.png", row.save)
    frames = viewer.turntable(cfg.frames)
    write_atomically(output / "turntable.webp", lambda path: _save_turning(frames, path))
    info = representation.info
    print(
        f"{info.name}: {representation.num_templates} templates of {info.image_size} px, "
        f"{len(representation.descriptors)} patches, {len(representation.words)} words, diameter {info.diameter:g}"
    )
    print("extractor: " + ", ".join(f"{key}={value}" for key, value in info.extractor.items()))
    print(f"written to {output}: templates.png, neighbours_0.png, …, turntable.webp")


def _save_turning(frames: list[Image.Image], path: Path) -> None:
    frames[0].save(path, save_all=True, append_images=frames[1:], duration=100, loop=0, quality=70)


def name_the_file(arguments: list[str]) -> list[str]:
    """Arguments of which one that is a file, and no override, is the representation."""
    return [
        f"representation='{argument}'" if "=" not in argument and Path(argument).is_file() else argument
        for argument in arguments
    ]


if __name__ == "__main__":
    sys.argv[1:] = name_the_file(sys.argv[1:])
    main()
