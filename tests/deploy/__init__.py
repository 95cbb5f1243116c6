"""The deployment files, checked without the machines that they are for."""
