"""Viewer of a trained field in a browser (viser), with the room, a movable transmitter and the spectrum at the receiver.

Modules: session -> drawing -> surroundings, figures -> panel, page -> app. The computations (session) do not depend on the
browser, and the drawing does not depend on fields. The browser runs `page.js`.
"""
