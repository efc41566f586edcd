"""Studies that repeat the paper's experiments on our captures."""
