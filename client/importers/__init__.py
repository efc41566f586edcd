"""Reads captures as calibration tools and cameras write them: rigs, lenses, pictures, videos."""
