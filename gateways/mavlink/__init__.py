"""MAVLink, message set ``common`` of ArduPilot: so far the codec, which no gateway uses yet."""
