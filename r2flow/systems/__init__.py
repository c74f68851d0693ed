"""The other systems of the paper's table I, a folder each: network, mathematics, generator, stage,
published files.
"""
