"""fewcal: camera calibration from one or two views of a board, with error bars that are true."""
