"""The console: what it says, and to whom."""
