"""From a config to a finished run: LightningModules, callbacks, run folders, summaries."""
