"""Metrics of one process: what was received, sent, dropped and refused. Every drop is counted.

``families`` names every metric, ``values`` are what the hot path adds to,
``registry`` keeps them, ``exposition`` writes them for Prometheus. Knows no
clock, loop or socket; :mod:`zbridge.app.endpoint` serves them.
"""

from zbridge.metrics.families import FAMILIES as FAMILIES
from zbridge.metrics.families import Family as Family
from zbridge.metrics.families import MetricKind as MetricKind
from zbridge.metrics.registry import OTHER as OTHER
from zbridge.metrics.registry import Metrics as Metrics
from zbridge.metrics.registry import Reading as Reading
from zbridge.metrics.values import Count as Count
from zbridge.metrics.values import Histogram as Histogram
from zbridge.metrics.values import Labels as Labels
