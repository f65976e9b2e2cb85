"""From a raw scan to a clean open surface: cleaning, trimming, smoothing, decimation."""
