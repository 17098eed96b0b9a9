"""Readers of captures and benchmarks: any supported folder in, one `Capture` out."""
