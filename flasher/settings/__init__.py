"""What is read from files: one way of reading, one style of telling what is wrong."""
