"""The studies as lessons 11 and 12 still see them; removed once these call the runner."""
