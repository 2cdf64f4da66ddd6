"""What ROS 2's middleware rmw_zenoh puts on Zenoh: keys, tokens, attachments, type hashes and CDR. Sans-IO.

Knows no robot, no bus and no fleet message: a view (``zbridge.views``) and a protocol (``gateways``) read and write the
same format. ``rmw_zenoh`` writes keys, and writes and reads liveliness tokens and attachments; ``types`` hashes, writes
and reads messages (rosbags, the extra ``zbridge[ros2]``, loaded with the first store of types).
Source of the format: rmw_zenoh_cpp 0.12.0.

A sample of a topic is put on :func:`topic_key`, its payload CDR, its attachment :class:`Attachment` with the gid of its
publisher's token. A service is a queryable, complete, on the same kind of key with the service's type and hash; a
request is a query whose attachment has the client's gid and a number from 1, and its reply's attachment repeats both.
"""
