"""Fine-tuning on the device: crops once, a step graph in a loop, SGMs watched while it runs."""
