"""All targets, by name."""

from tests.fuzz import codecs, files, payloads, sessions
from tests.fuzz.target import Target

TARGETS: dict[str, Target] = {
    target.name: target for room in (codecs, sessions, payloads, files) for target in room.targets()
}
