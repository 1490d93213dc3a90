"""The routes of the HTTP interface: what they take and answer, the event stream, pictures and the page."""
