"""Reads the picture of a robot back from its page: which places of the robot's frame have which colour."""

from __future__ import annotations

from typing import Any

MOST = 2000
"""Most pixels of a colour that are given, spread evenly."""
_READ = """([colors, MOST]) => {
  const canvas = document.querySelector('.picture canvas');
  const { width, height } = canvas;
  const back = new DOMMatrix(JSON.parse(canvas.dataset.view)).inverse();
  const pixels = canvas.getContext('2d').getImageData(0, 0, width, height).data;
  const style = getComputedStyle(canvas);
  const found = {};
  for (const name of colors) {
    const color = style.getPropertyValue(`--scene-${name}`).trim();
    const [r, g, b] = [1, 3, 5].map((at) => parseInt(color.slice(at, at + 2), 16));
    found[name] = [];
    for (let index = 0; index < width * height; index++) {
      if (pixels[4 * index] !== r || pixels[4 * index + 1] !== g || pixels[4 * index + 2] !== b) continue;
      const { x, y } = back.transformPoint({ x: (index % width) + 0.5, y: Math.floor(index / width) + 0.5 });
      found[name].push([x, y]);
    }
    const every = Math.ceil(found[name].length / MOST);
    if (every > 1) found[name] = found[name].filter((_, index) => index % every === 0);
  }
  return found;
}"""

Places = list[tuple[float, float]]


async def places(page: Any, *colors: str) -> dict[str, Places]:
    """Give the places, in metres, of the pixels that have these colours of the scene."""
    await page.locator(".picture canvas[data-view]").wait_for()
    found: dict[str, Places] = await page.evaluate(_READ, [list(colors), MOST])
    return found


def middle(points: Places) -> tuple[float, float]:
    """Give the centre of some places."""
    return sum(x for x, _ in points) / len(points), sum(y for _, y in points) / len(points)
