"""Import of captures in other layouts: a module for each format or family of formats, whose `import_…` functions write a capture.json.

The functions share these arguments, and say only where they take them otherwise:

    source       the folder of the images or arrays
    destination  the folder of the capture; another folder than the source gets links to, or copies of, the images
    selection    which images are frames; None: all but mask and ambient light
    view         the camera; None: orthographic, of unknown scale
    camera       a file with the matrix of the camera; None: as `view` says
    lights       the file of the lights; None: the only table in the folder
    color_space  of the images; None: sRGB of 8-bit images, scene-linear of others

Every function raises ManifestError, which names the file and where it can the line, where a file does not hold what it should, or files
do not fit each other or the options.
"""
