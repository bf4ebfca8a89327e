"""Draw the pictures of the cards, one small figure of each page: ``python docs/cards.py [page ...]``."""

from __future__ import annotations

import io
import sys
from pathlib import Path

import matplotlib

matplotlib.use("Agg")

from PIL import Image

DOCS = Path(__file__).resolve().parent
CARDS = DOCS / "images" / "cards"

FIGURES = {
    **{f"start/{name}": 0 for name in "spacecraft relaxation magnets fluids quantum learning geometer".split()},
    "start/method_author": 0,
    "tutorials/first_run": 0,
    "howto/real_bodies": 0,
    "howto/torques": 0,
}
"""Pages, and which of their figures the card shows."""

CARD_STYLE = {"font.size": 14, "legend.fontsize": 12, "lines.linewidth": 2.2}
"""Text and lines that can be read in a card, which is smaller than the figure of the page."""

SIZE = (560, 320)
"""Width and height of a card (pixels); a figure is fitted into it on white."""


def draw_card(page: str, index: int) -> Path:
    """Run the code of a page and write one of its figures as the picture of its card."""
    sys.path.append(str(DOCS / "_ext"))
    from executed import run_page

    matplotlib.rcParams.update(CARD_STYLE)
    results = run_page(page, (DOCS / f"{page}.md").read_text())
    if results.failures:
        raise RuntimeError(f"{page}: {'; '.join(results.failures)}")
    figures = [figure for output in results.outputs for figure in output.figures]
    picture = Image.open(io.BytesIO(figures[index])).convert("RGB")
    picture.thumbnail(SIZE, Image.Resampling.LANCZOS)
    card = Image.new("RGB", SIZE, "white")
    card.paste(picture, ((SIZE[0] - picture.width) // 2, (SIZE[1] - picture.height) // 2))
    CARDS.mkdir(parents=True, exist_ok=True)
    path = CARDS / f"{page.partition('/')[2]}.png"
    card.quantize(256).save(path, optimize=True)
    return path


if __name__ == "__main__":
    for name in sys.argv[1:] or FIGURES:
        print(draw_card(name, FIGURES[name]))
