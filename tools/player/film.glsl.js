// How a Gaussian follows the nodes; the definition is that of GridFollowers in mpm/followers.py.

export const FUNCTIONS = `
  ivec2 filmTexel(int index) {
    return ivec2(index & 2047, index >> 11);
  }

  // Values and slopes of the three quadratic B-splines at a distance from the first node, in cells.
  void filmWeights(float f, out vec3 w, out vec3 slope) {
    float middle = f - 1.0;
    w = vec3(0.5 * (1.5 - f) * (1.5 - f), 0.75 - middle * middle, 0.5 * (f - 0.5) * (f - 0.5));
    slope = vec3(f - 1.5, -2.0 * middle, f - 0.5);
  }

  // The covariance of a quaternion wxyz and standard deviations.
  mat3 filmCovariance(vec4 q, vec3 s) {
    q /= length(q);
    mat3 R = mat3(
      1.0 - 2.0 * (q.z * q.z + q.w * q.w), 2.0 * (q.y * q.z + q.x * q.w), 2.0 * (q.y * q.w - q.x * q.z),
      2.0 * (q.y * q.z - q.x * q.w), 1.0 - 2.0 * (q.y * q.y + q.w * q.w), 2.0 * (q.z * q.w + q.x * q.y),
      2.0 * (q.y * q.w + q.x * q.z), 2.0 * (q.z * q.w - q.x * q.y), 1.0 - 2.0 * (q.y * q.y + q.z * q.z)
    );
    mat3 axes = mat3(R[0] * s.x, R[1] * s.y, R[2] * s.z);
    return axes * transpose(axes);
  }

  // Rotation wxyz and standard deviations of a covariance, by Jacobi's rotations.
  void filmAxes(mat3 A, out vec4 q, out vec3 s) {
    q = vec4(1.0, 0.0, 0.0, 0.0);
    for (int k = 0; k < 15; ++k) {
      int a = k % 3, b = (k + 1) % 3;
      if (A[a][b] == 0.0) continue;
      float skew = 0.5 * (A[b][b] - A[a][a]) / A[a][b];
      float t = (skew < 0.0 ? -1.0 : 1.0) / (abs(skew) + sqrt(skew * skew + 1.0));
      float c = inversesqrt(t * t + 1.0);
      mat3 J = mat3(1.0);
      J[a][a] = J[b][b] = c;
      J[a][b] = -(J[b][a] = t * c);
      A = transpose(J) * A * J;
      vec4 h = vec4(sqrt(0.5 + 0.5 * c), 0.0, 0.0, 0.0); // the same rotation, by half the angle about the third axis
      h[1 + (k + 2) % 3] = -0.5 * t * c / h.x;
      q = vec4(q.x * h.x - dot(q.yzw, h.yzw), q.x * h.yzw + h.x * q.yzw + cross(q.yzw, h.yzw));
    }
    s = sqrt(max(vec3(A[0][0], A[1][1], A[2][2]), 0.0));
  }

  // A factor of the captured colour, as in rendering/shading.py: light, then (two-sided, ambient, relative, on).
  float filmLambert(vec3 normal, vec3 light, vec4 kind) {
    float cosine = dot(normal, light);
    cosine = kind.x > 0.5 ? abs(cosine) : max(cosine, 0.0);
    return kind.y + (1.0 - kind.y) * cosine;
  }
`;

// The motion of a Gaussian.
const MOTION = (i) => `
  uvec4 placed = texelFetch(${i.place}, texel, 0);
  vec3 place = uintBitsToFloat(placed.xyz);
  int first = 9 * int(placed.w);
  vec3 f = place - floor(place - 0.5);
  vec3 wx, wy, wz, sx, sy, sz;
  filmWeights(f.x, wx, sx);
  filmWeights(f.y, wy, sy);
  filmWeights(f.z, wz, sz);
  vec3 u = vec3(0.0);
  mat3 G = mat3(0.0);
  for (int a = 0; a < 3; ++a) {
    for (int b = 0; b < 3; ++b) {
      uvec4 along_z = texelFetch(${i.rows}, filmTexel(first + 3 * a + b), 0);
      vec3 q0 = texelFetch(${i.moved}, filmTexel(int(along_z.x)), 0).xyz;
      vec3 q1 = texelFetch(${i.moved}, filmTexel(int(along_z.y)), 0).xyz;
      vec3 q2 = texelFetch(${i.moved}, filmTexel(int(along_z.z)), 0).xyz;
      vec3 value = (wz.x * q0 + wz.y * q1 + wz.z * q2) * ${i.metre};
      vec3 along = (sz.x * q0 + sz.y * q1 + sz.z * q2) * ${i.metre};
      u += wx[a] * wy[b] * value;
      G[0] += sx[a] * wy[b] * value;
      G[1] += wx[a] * sy[b] * value;
      G[2] += wx[a] * wy[b] * along;
    }
  }
  mat3 F = mat3(1.0) + G / ${i.cell};
  vec3 arm = center - (place * ${i.cell} + ${i.corner});
  center += u + (F - mat3(1.0)) * arm;

  mat3 own = A;
  A = F * A * transpose(F);
  float before = own[0][0] + own[1][1] + own[2][2];
  float after = A[0][0] + A[1][1] + A[2][2];
  float excess = ${i.limit} * before;
  if (after - before > excess) {
    // limit_stretch: back towards the own shape, turned with the material, or towards a ball
    mat3 shape = mat3(before / 3.0);
    if (facing.w > 0.5 && determinant(F) > 0.0) {
      mat3 R = F;
      for (int k = 0; k < 8; ++k) R = 0.5 * (R + transpose(inverse(R)));
      shape = R * own * transpose(R);
    }
    float weight = excess / (after - before);
    A = weight * A + (1.0 - weight) * shape;
  }

  vec3 n = cross(F[1], F[2]) * facing.x + cross(F[2], F[0]) * facing.y + cross(F[0], F[1]) * facing.z;
  float size = length(n);
  if (size > 0.0) normal = n / size * (determinant(F) < 0.0 ? -1.0 : 1.0);
`;

// The light on it.
const LIGHT = (i) => `
  if (${i.kind}.w > 0.5) {
    float factor = filmLambert(normal, ${i.light}, ${i.kind});
    if (${i.kind}.z > 0.5) {
      factor = max(factor, 0.1) / max(filmLambert(facing.xyz, ${i.light}, ${i.kind}), 0.1);
    }
    color *= factor;
  }
`;

// What is read of a Gaussian that may move.
const FACING = (i) => `
  uvec4 turned = texelFetch(${i.facing}, texel, 0);
  vec4 facing = vec4(unpackSnorm2x16(turned.x), unpackSnorm2x16(turned.y));
  vec3 normal = facing.xyz;
`;

// A Gaussian at rest: center, color, opacity and covariance A. `grown` is how much larger all would have to be to cover as much as when all have come.
export const REST = (i) => `
  ivec2 texel = filmTexel(${i.index});
  uvec4 rest = texelFetch(${i.rest}, texel, 0);
  uvec4 sizes = texelFetch(${i.shape}, texel, 0);
  vec3 center = uintBitsToFloat(rest.xyz);
  vec4 rgba = vec4(uvec4(rest.w, rest.w >> 8, rest.w >> 16, rest.w >> 24) & 255u) / 255.0;
  vec3 color = rgba.rgb;
  mat3 A = filmCovariance(
    vec4(unpackSnorm2x16(sizes.x), unpackSnorm2x16(sizes.y)),
    max(1.0, ${i.grown} * float((sizes.w >> 16) & 255u) / 255.0) * exp(vec3(unpackHalf2x16(sizes.z), unpackHalf2x16(sizes.w).x))
  );
`;

// How one that may move changes, with its light; one that never moves has none.
export const MOVING = (i) => FACING(i) + MOTION(i) + LIGHT(i);
