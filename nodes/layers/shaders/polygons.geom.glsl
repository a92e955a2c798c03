// Geometry generation of polygons: lower end, side and upper end of a wedge as one strip ("Attributed Vertex Clouds",
// listing 1.8), or what there is of them. Counterclockwise from outside. Goes behind emit.glsl.

layout(points) in;
layout(triangle_strip, max_vertices = 6) out;
in Wedge { vec3 start, end, center, colour, normal; float upper; flat int has_side, has_ends; } wedge[];

const vec3 UP = vec3(0, 0, 1);

void main() {
    vec3 start = wedge[0].start, end = wedge[0].end, center = wedge[0].center;
    vec3 start_above = vec3(start.xy, wedge[0].upper), end_above = vec3(end.xy, wedge[0].upper);
    vec3 center_above = vec3(center.xy, wedge[0].upper);
    vec3 colour = wedge[0].colour, normal = wedge[0].normal;
    if (wedge[0].has_ends == 1) {
        emit(center, -UP, colour);
        emit(end, -UP, colour);
        emit(start, -UP, colour);
        if (wedge[0].has_side == 1) {
            emit(end_above, normal, colour);
            emit(start_above, normal, colour);
        } else {
            EndPrimitive();
            emit(start_above, UP, colour);
            emit(end_above, UP, colour);
        }
        emit(center_above, UP, colour);
    } else if (wedge[0].has_side == 1) {
        emit(end, normal, colour);
        emit(end_above, normal, colour);
        emit(start, normal, colour);
        emit(start_above, normal, colour);
    }
    EndPrimitive();
}
