// A cube of half edge 1 as one strip of 14 vertices ("Attributed Vertex Clouds", listing 1.3). A triangle has the
// normal of its last vertex, so normals are flat; those of the first two vertices are not used.

const vec3 CORNER[14] = vec3[](
    vec3(-1, 1, -1), vec3(-1, 1, 1), vec3(1, 1, -1), vec3(1, 1, 1), vec3(1, -1, 1), vec3(-1, 1, 1), vec3(-1, -1, 1),
    vec3(-1, 1, -1), vec3(-1, -1, -1), vec3(1, 1, -1), vec3(1, -1, -1), vec3(1, -1, 1), vec3(-1, -1, -1), vec3(-1, -1, 1));
const vec3 NORMAL[14] = vec3[](
    vec3(0, 1, 0), vec3(0, 1, 0), vec3(0, 1, 0), vec3(0, 1, 0), vec3(1, 0, 0), vec3(0, 0, 1), vec3(0, 0, 1),
    vec3(-1, 0, 0), vec3(-1, 0, 0), vec3(0, 0, -1), vec3(0, 0, -1), vec3(1, 0, 0), vec3(0, -1, 0), vec3(0, -1, 0));
