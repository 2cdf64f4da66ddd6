"""The channels that viewers are offered, and who subscribed to which. Sans-IO.

Work on demand: the source is notified when a viewer subscribes to a channel and when the last one leaves it, and
publishes what is wanted only. The last message of a channel that keeps it is shown to whoever subscribes later.
"""

from __future__ import annotations

import itertools
from collections.abc import Callable, Iterable, Mapping
from typing import Any, Protocol

import msgspec

from zbridge.views.foxglove import replies
from zbridge.views.pictures import ViewerChannel

CHANNELS = 8192
"""Most channels at a time."""


class Subscriber(Protocol):
    """A viewer, as hub and sources need it.

    name: shown to others as the driver. may_drive: whether its commands may move robots and change them.
    """

    name: str
    may_drive: bool

    def say(self, message: str | bytes) -> None:
        """Send an answer or news."""

    def show(self, subscription: int, message: bytes) -> None:
        """Send a message of a channel."""

    def ended(self, subscription: int) -> None:
        """Forget a subscription: its channel is withdrawn."""

    def warn(self, text: str) -> None:
        """Tell the person something."""

    def parameters_changed(self, values: Mapping[str, Any]) -> None:
        """Send parameters, where the viewer watches them."""


class _Offer(msgspec.Struct, eq=False):
    """A channel that viewers are offered. wanted_by: its viewers, and their subscriptions. last: its last message."""

    id: int
    channel: ViewerChannel
    entry: msgspec.Raw
    wanted_by: dict[Subscriber, int] = {}
    last: tuple[int, bytes] | None = None


class Hub:
    """Knows channels and viewers.

    on_wanted: called with a channel when a viewer subscribes to it (True), and when its last one goes (False).
    """

    def __init__(self) -> None:
        self.on_wanted: Callable[[ViewerChannel, bool], None] = lambda channel, wanted: None
        self.viewers: set[Subscriber] = set()
        self._offers: dict[int, _Offer] = {}
        self._by_topic: dict[str, _Offer] = {}
        self._warnings: dict[str, str] = {}
        self._ids = itertools.count(1)

    def __repr__(self) -> str:
        return f"<Hub of {len(self._offers)} channels, {len(self.viewers)} viewers>"

    # The source's side

    def offer(self, channels: Iterable[ViewerChannel]) -> int:
        """Offer channels to all viewers; those that are offered already are left. Return how many had no place."""
        new, left_out = [], 0
        for channel in channels:
            if channel.topic in self._by_topic:
                continue
            if len(self._offers) >= CHANNELS:
                left_out += 1
                continue
            number = next(self._ids)
            offer = _Offer(number, channel, replies.channel_entry(number, channel))
            self._offers[offer.id] = self._by_topic[channel.topic] = offer
            new.append(offer.entry)
        if new:
            self.say(replies.advertise(new))
        return left_out

    def withdraw(self, topics: Iterable[str]) -> None:
        """Withdraw channels; their subscriptions end."""
        gone = [offer for topic in topics if (offer := self._by_topic.pop(topic, None)) is not None]
        for offer in gone:
            del self._offers[offer.id]
            for viewer, subscription in offer.wanted_by.items():
                viewer.ended(subscription)
            if offer.wanted_by:
                self.on_wanted(offer.channel, False)
        if gone:
            self.say(replies.text("unadvertise", channelIds=[offer.id for offer in gone]))

    def publish(self, topic: str, stamp_ns: int, payload: bytes) -> None:
        """Show a message to the viewers of a channel."""
        offer = self._by_topic.get(topic)
        if offer is None:
            return
        if offer.channel.keeps_last and offer.wanted_by:
            offer.last = (stamp_ns, payload)
        for viewer, subscription in offer.wanted_by.items():
            viewer.show(subscription, replies.message_data(subscription, stamp_ns, payload))

    def say(self, message: str | bytes) -> None:
        """Tell all viewers."""
        for viewer in self.viewers:
            viewer.say(message)

    def warn(self, name: str, text: str | None) -> None:
        """Show all viewers, those who come later too, what holds until it is called anew with the same name."""
        if self._warnings.get(name) == text:
            return
        if text is None:
            del self._warnings[name]
            self.say(replies.text("removeStatus", statusIds=[name]))
        else:
            self._warnings[name] = text
            self.say(replies.warning(text, name))

    def parameters_changed(self, values: Mapping[str, Any]) -> None:
        for viewer in self.viewers:
            viewer.parameters_changed(values)

    def wanted(self) -> list[ViewerChannel]:
        """Return the channels that viewers subscribed to."""
        return [offer.channel for offer in self._offers.values() if offer.wanted_by]

    # The viewers' side

    def join(self, viewer: Subscriber) -> None:
        """Show a viewer the channels there are, and the warnings that hold."""
        self.viewers.add(viewer)
        if self._offers:
            viewer.say(replies.advertise(offer.entry for offer in self._offers.values()))
        for name, text in self._warnings.items():
            viewer.say(replies.warning(text, name))

    def leave(self, viewer: Subscriber) -> None:
        """End a viewer's subscriptions; idempotent."""
        self.viewers.discard(viewer)
        for offer in list(self._offers.values()):
            self._leave(viewer, offer)

    def subscribe(self, viewer: Subscriber, subscription: int, channel_id: int) -> bool:
        """Subscribe a viewer to a channel it is not subscribed to; False for an unknown channel."""
        offer = self._offers.get(channel_id)
        if offer is None:
            return False
        offer.wanted_by[viewer] = subscription
        if offer.last is not None:
            viewer.show(subscription, replies.message_data(subscription, *offer.last))
        self.on_wanted(offer.channel, True)
        return True

    def unsubscribe(self, viewer: Subscriber, channel_id: int) -> None:
        offer = self._offers.get(channel_id)
        if offer is not None:
            self._leave(viewer, offer)

    def _leave(self, viewer: Subscriber, offer: _Offer) -> None:
        if offer.wanted_by.pop(viewer, None) is not None and not offer.wanted_by:
            offer.last = None  # nothing renews it any more
            self.on_wanted(offer.channel, False)
