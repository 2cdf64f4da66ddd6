"""``scene``: a listener that runs; ``@pytest.mark.scene(...)`` at a test gives its settings."""

from tests.clock import scene_of
from tests.hq.scene import serving

scene = scene_of(serving)
