// Runs → pieces of at most piece_points points, even work for workgroups; one invocation a piece.
// COMMANDS: also one indirect draw a piece, whose base instance fetches the piece.  POOLS: pieces are units of pools,
// drawn as all pairs of their vertices (instances) and translations.

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
    uint first = run.first + done * run.stride;
    pieces[i] = uvec4(first, count, run.stride, run.block);
#ifdef COMMANDS
#ifdef POOLS
    Unit unit = units[first];
    bool pooled = unit.tag_words > 0u;
    commands[i] = Command(pooled ? unit.n_translations : unit.count, pooled ? unit.count : 1u, 0u, i, 0u);
#else
    commands[i] = Command(count, 1u, 0u, i, 0u);
#endif
#endif
}
