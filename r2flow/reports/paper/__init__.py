"""The paper's tables and figures from run folders: ours beside the printed ones, and what became of its claims."""
