// What a geometry shader gets of nodes. Goes behind trajectory.glsl.

in Vertex { vec3 position; float value, radius, pixel; flat uint flags; } vertex[];

// not a function: how many there are is only known behind the shader's layout
#define node(i) Node(vertex[i].position, vertex[i].value, vertex[i].radius, vertex[i].pixel, vertex[i].flags)
