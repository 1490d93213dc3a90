"""How late a camera's stamps are against the joints' readings, measured by turning the head to and fro."""
