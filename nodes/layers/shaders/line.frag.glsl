// Lines have no side that light could fall on. Goes behind word.glsl.

flat in vec3 base_colour;

void main() {
    write_word(base_colour);
}
