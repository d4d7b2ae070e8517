"""Video input by exact frame number, and video output from images (PyAV).

Input: a video file, a folder of images, or images. Output: images by frame number and their times,
or a file.
"""
