// Runs → pieces of at most piece_points points, even work for workgroups; one invocation a piece.
// COMMANDS: also one indirect draw a piece, whose base instance fetches the piece.

layout(std430, binding = 8) restrict writeonly buffer Pieces { uvec4 pieces[]; };  // first, count, stride, block
#ifdef COMMANDS
struct Command { uint count, instances, first_vertex, base_instance, padding; };  // the binding steps 20 bytes
layout(std430, binding = 10) restrict writeonly buffer Commands { Command commands[]; };
#endif
uniform uint piece_points;

void main() {
    uint i = invocation();
    if (i >= n_units) return;
    Run run = runs[run_of(first_unit + i)];
    uint done = (first_unit + i - run.first_unit) * piece_points;
    uint count = min(run.count - done, piece_points);
    pieces[i] = uvec4(run.first + done * run.stride, count, run.stride, run.block);
#ifdef COMMANDS
    commands[i] = Command(count, 1u, 0u, i, 0u);
#endif
}
