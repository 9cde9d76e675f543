"""The recorded versions (`workflows.recording`), a folder each, and the page that shows them."""
