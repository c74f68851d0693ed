"""Data sets, the loader of a run, and the DataModule that all stages share."""
