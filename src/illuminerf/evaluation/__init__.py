"""Scores: image metrics, colour rescaling, the benchmarks' rules, tables beside the published figures."""
