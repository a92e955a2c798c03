// The matrices of what a frame draws: of blocks, or of pooled cells.

layout(std430, binding = 6) restrict readonly buffer Rows { mat3x4 rows[]; };  // columns are the rows of a matrix
