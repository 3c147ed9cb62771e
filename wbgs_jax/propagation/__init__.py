"""Ray tracing over a mesh and the received field: facets -> edges -> image_method -> paths -> materials, utd -> transport ->
mechanisms."""
