"""How results are shown: pages by jinja2, plots by matplotlib, pictures by OpenCV, tables for all of them."""
