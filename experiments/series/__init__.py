"""One change at a time, everything else equal: what the choices of this project were made by."""
