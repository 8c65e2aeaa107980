#version 450
// Transforms the vertices of one shape. SAPIEN binds its buffers by these declarations.

#include "../common/camera.glsl"
#include "../common/object.glsl"

layout(location = 0) in vec3 position;
layout(location = 1) in vec3 normal;
layout(location = 2) in vec2 uv;

layout(location = 0) out vec3 worldNormal;
layout(location = 1) out vec2 textureUV;

void main() {
  // No shape is scaled, so normals are rotated as the shape is.
  worldNormal = mat3(object.modelMatrix) * normal;
  textureUV = uv;
  gl_Position =
      camera.projectionMatrix * camera.viewMatrix * object.modelMatrix * vec4(position, 1.0);
}
