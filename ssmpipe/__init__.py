"""Raw anatomical surfaces in, a statistical shape model with certified dense correspondence out."""

__version__ = "0.1.0"
