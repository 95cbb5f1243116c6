"""The images without a container engine: their environments, and the services run from them."""
