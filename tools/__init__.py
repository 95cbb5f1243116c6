"""What is run by hand while Placewise is developed; nothing of it is installed."""
