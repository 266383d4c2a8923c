"""The Panda arm and its task-space control."""
