"""Pictures: raw pixel encodings and image files, shared by ingestion (`image` settings), views and export.

Input: the buffer of an image and its layout, or an image file. Output: arrays of samples, or image files. The package depends
on no other stage; only `files` imports Pillow, when an image file is read or written.
"""
