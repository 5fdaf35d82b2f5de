// A minimal cut between two sides of a graph whose nodes have four edges each (Dinic 1970): which nodes
// belong to the first side, the fewer where there is a choice.
#pragma once
#include "cutting/surface.h"

namespace palpate {

struct Flow {
  int count;
  int *to, *back, *room;  // of edge 4 n + k: its other node, -1 for none; that edge there; what passes
  int *source, *sink;  // what passes from the one side, and to the other
  int *level, *next, *queue, *path;

  // Numbers nodes by their distance from the first side, 0 for those that nothing reaches; returns whether
  // the other side is.
  PALPATE bool reach() {
    int n = 0;
    bool there = false;
    for (int v = 0; v < count; ++v) {
      next[v] = 0, level[v] = source[v] > 0;
      if (level[v]) queue[n++] = v;
    }
    for (int i = 0; i < n; ++i) {
      const int v = queue[i];
      there = there || sink[v] > 0;
      for (int a = 4 * v; a < 4 * v + 4; ++a)
        if (to[a] >= 0 && room[a] > 0 && !level[to[a]]) level[to[a]] = level[v] + 1, queue[n++] = to[a];
    }
    return there;
  }
  // Lets through what it can along one way from a node; returns whether there was one.
  PALPATE bool push(int start) {
    int top = 0, v = start;
    while (sink[v] == 0) {
      int& k = next[v];
      for (; k < 4; ++k) {
        const int a = 4 * v + k;
        if (to[a] >= 0 && room[a] > 0 && level[to[a]] == level[v] + 1) break;
      }
      if (k < 4) {
        path[top++] = 4 * v + k, v = to[4 * v + k];
        continue;
      }
      if (!top) return false;
      v = path[--top] / 4, ++next[v];
    }
    int least = source[start] < sink[v] ? source[start] : sink[v];
    for (int i = 0; i < top; ++i) least = room[path[i]] < least ? room[path[i]] : least;
    source[start] -= least, sink[v] -= least;
    for (int i = 0; i < top; ++i) room[path[i]] -= least, room[back[path[i]]] += least;
    return true;
  }
  // Leaves in `level` 0 for the nodes of the other side.
  PALPATE void part() {
    while (reach())
      for (int v = 0; v < count; ++v)
        while (source[v] > 0 && push(v)) {}
  }
};

PALPATE Flow flow_of(Scratch& memory, int count) {
  Flow out = {count};
  int** lists[] = {&out.to, &out.back, &out.room, &out.source, &out.sink,
                   &out.level, &out.next, &out.queue, &out.path};
  for (int i = 0; i < 9; ++i) *lists[i] = memory.numbers(i < 3 ? 4 * count : count);
  return out;
}

}  // namespace palpate
