"""How any stage runs: artefacts and their fingerprints, configs as JSON, checkpoints, progress, errors."""
