"""What travels on the bus: fleet messages, the keys they travel on, and how each is delivered. Sans-IO."""
