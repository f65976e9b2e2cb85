"""The HTML report."""

from ssmpipe.report._cache import give_a_cache

give_a_cache()  # here, because every module below may be the first to import matplotlib
