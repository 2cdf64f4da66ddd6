"""The diagrams of the documentation, drawn from the tables and settings of the code."""
