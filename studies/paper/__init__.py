"""The paper's experiments on our captures."""
