"""One HTML file for a run: nothing in it is fetched from anywhere."""
