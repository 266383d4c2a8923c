"""What the pictures of the lessons compute: plain functions from numbers to arrays."""
