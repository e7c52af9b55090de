"""Files, devices, timing, progress, batch size."""
