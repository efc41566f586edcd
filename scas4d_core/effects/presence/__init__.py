"""Effects on which Gaussians exist and which move: masks, labels, objects that enter or leave."""
