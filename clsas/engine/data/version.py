"""The version of clsas."""

__version__ = "0.1.0"
