// Nodes as attributed vertices. Goes behind trajectory_node.glsl.

in vec3 position, motion;
in uint owner;
out Vertex { vec3 position; float value, radius, pixel; flat uint flags; } vertex;

void main() {
    Node n = node_of(position, motion, owner);
    vertex.position = n.position;
    vertex.value = n.value;
    vertex.radius = n.radius;
    vertex.pixel = n.pixel;
    vertex.flags = n.flags;
}
