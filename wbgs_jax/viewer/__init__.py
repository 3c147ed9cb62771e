"""A trained field in a browser (viser): a room to look at, a transmitter to drag, and what its receiver sees.

asking -> drawing -> scene, panel -> app. What is computed knows nothing of the browser, and what is drawn nothing of fields.
"""
