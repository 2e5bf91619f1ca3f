PGEOMETRY V5
NPoints 2 NPrims 1
NPointGroups 1 NPrimGroups 0
NPointAttrib 3 NVertexAttrib 0 NPrimAttrib 0 NAttrib 0
PointAttrib
v 3 vector 0 0 0
id 1 int 0
m 1 index 2 water oil
0 1 2 1 (0 0 -1 7 0)
1 1 2 1 (0 0 -1 8 1)
Part 2 0 1
a unordered
2 01
beginExtra
endExtra
