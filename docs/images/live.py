"""Makes live.gif: a dam break and its surfaces, frame by frame. Needs Pillow; run it in the root of the
repository:

    cargo build --release --bin meniscus && cargo build --release -p dam_break && python docs/images/live.py

The particles are on the left, and their surface on the right.
"""

import os
import subprocess
import tempfile
from pathlib import Path

from PIL import Image

TARGET = Path(os.environ.get("CARGO_TARGET_DIR", "target")) / "release"
FRAMES = 72
SIZE = (760, 280)
PICTURE = Path("docs/images/live.gif")
# Fewer colours cause bands on the ground; more make the file larger.
COLORS = 128
MILLISECONDS = 50


def main():
    with tempfile.TemporaryDirectory() as folder:
        cache, pictures = Path(folder) / "cache", Path(folder) / "pictures"
        subprocess.run([TARGET / "dam_break", cache, str(FRAMES)], check=True)
        size = "x".join(map(str, SIZE))
        render = [TARGET / "meniscus", "render", cache, "--out", pictures, "--particles", "--size", size]
        subprocess.run(render, check=True, stdout=subprocess.DEVNULL)
        frames = [Image.open(path).convert("RGB") for path in sorted(pictures.glob("*.png"))]
    # One palette for all frames, so that colours do not flicker. MAXCOVERAGE, because most pixels are shades
    # of the shadow: with another method they would leave no room in the palette for the colours of the water.
    shown = Image.new("RGB", (SIZE[0], SIZE[1] * len(frames[::8])))
    for place, frame in enumerate(frames[::8]):
        shown.paste(frame, (0, SIZE[1] * place))
    palette = shown.quantize(COLORS, method=Image.Quantize.MAXCOVERAGE)
    first, *others = [frame.quantize(palette=palette, dither=Image.Dither.NONE) for frame in frames]
    first.save(PICTURE, save_all=True, append_images=others, duration=MILLISECONDS, loop=0, optimize=True)


if __name__ == "__main__":
    main()
