#version 450
// Draws one shape as the sun sees it: only its depth is kept.

layout(set = 0, binding = 0) uniform LightBuffer {
  mat4 viewMatrix;
  mat4 viewMatrixInverse;
  mat4 projectionMatrix;
  mat4 projectionMatrixInverse;
  int width;
  int height;
} sun;

#include "../common/object.glsl"

layout(location = 0) in vec3 position;
layout(location = 1) in vec3 normal;
layout(location = 2) in vec2 uv;

void main() {
  gl_Position = sun.projectionMatrix * sun.viewMatrix * object.modelMatrix * vec4(position, 1.0);
}
