"""Effects that decide which Gaussians exist and which move: masks, labels, and objects that enter or leave."""
