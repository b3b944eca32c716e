"""Publish a capture as static files: IIIF, coefficient planes for OpenLIME, and a page that lights it live."""
