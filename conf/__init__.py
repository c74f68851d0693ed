"""The configs of `r2flow train`: YAML files in a folder for each group."""
